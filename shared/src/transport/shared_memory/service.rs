//! A private, file-backed iceoryx2 service: all resources are files below the run's directory.
//!
//! The standard `ipc` service keeps part of its state in `/dev/shm` under names that any user can
//! squat. With the file-backed building blocks of `iceoryx2-cal`, a directory with mode 0700
//! restricts access, and removing it removes everything. These are internal crates of iceoryx2, so
//! their versions are pinned exactly.

use std::fmt::{Debug, Display};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use iceoryx2::config::Config;
use iceoryx2::node::{Node, NodeBuilder, NodeState};
use iceoryx2::prelude::{
    CallbackProgression, FileName, FilePath, LogLevel, SemanticString, ServiceName,
    SignalHandlingMode, set_log_level,
};
use iceoryx2::service::Service;
use iceoryx2_bb_elementary_traits::testing::abandonable::Abandonable;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;
use iceoryx2_cal::shm_allocator::bump_allocator::BumpAllocator;
use iceoryx2_cal::shm_allocator::pool_allocator::PoolAllocator;
use iceoryx2_cal::{
    arc_sync_policy, bag, dynamic_storage, event, hash, monitoring, reactor,
    resizable_shared_memory, serialize, shared_memory, static_storage, zero_copy_connection,
};

use crate::transport::TransportError;

/// Prefix of every file that iceoryx2 creates. It is short because Unix socket paths are limited to
/// 108 bytes. Different runs are in different directories, so they may share it.
pub(super) const PREFIX: &str = "d_";
/// The iceoryx2 configuration, which the learner writes and every process of the run reads.
const CONFIG_FILE: &str = "iceoryx2.toml";

/// The service variant. Mutexes protect its ports, so that they may move to another thread.
#[derive(Debug, Clone)]
pub(super) struct PrivateIpc {}

type FileMemory<Allocator> = shared_memory::file::Memory<Allocator>;

impl Service for PrivateIpc {
    type StaticStorage = static_storage::recommended::Ipc;
    type ConfigSerializer = serialize::recommended::Recommended;
    type PersistentDynamicStorage<T: Debug + Send + Sync + ZeroCopySend + 'static> =
        dynamic_storage::file::Storage<T>;
    type Bag = bag::recommended::Recommended;
    type DynamicStorage<T: Debug + Send + Sync + ZeroCopySend + 'static> =
        dynamic_storage::file::Storage<T>;
    type ServiceNameHasher = hash::recommended::Recommended;
    type SharedMemory = FileMemory<PoolAllocator>;
    type ResizableSharedMemory =
        resizable_shared_memory::dynamic::DynamicMemory<PoolAllocator, FileMemory<PoolAllocator>>;
    type Connection = zero_copy_connection::file::Connection;
    type Event = event::recommended::Ipc;
    type Monitoring = monitoring::recommended::Ipc;
    type Reactor = reactor::recommended::Ipc;
    type ArcThreadSafetyPolicy<T: Send + Debug + Abandonable> =
        arc_sync_policy::mutex_protected::MutexProtected<T>;
    type BlackboardMgmt<K: Send + Sync + Debug + ZeroCopySend + 'static> =
        dynamic_storage::file::Storage<K>;
    type BlackboardPayload = FileMemory<BumpAllocator>;
    type UniqueId = iceoryx2::unique_id_generator::unique_system_id::UniqueSystemId;
}

impl iceoryx2::service::internal::ServiceInternal<PrivateIpc> for PrivateIpc {}

/// Returns a converter from an error of the middleware to one with operation and target.
pub(super) fn middleware_error<E: Display>(
    operation: &'static str,
    name: impl Display,
) -> impl FnOnce(E) -> TransportError {
    move |cause| TransportError::Middleware {
        operation,
        name: name.to_string(),
        cause: cause.to_string(),
    }
}

/// Validates a service name.
pub(super) fn service_name(name: &str) -> Result<ServiceName, TransportError> {
    name.try_into().map_err(middleware_error("naming the service", name))
}

/// Writes the iceoryx2 configuration for `root` into that directory.
///
/// iceoryx2 reads its process-wide configuration only from a file. Without one, the cleanup of a
/// process that died during its start would search below iceoryx2's default paths.
pub(super) fn write_config(root: &Path) -> Result<(), TransportError> {
    let operation = "writing the configuration in";
    let root_path = iceoryx2::prelude::Path::new(root.as_os_str().as_encoded_bytes())
        .map_err(middleware_error(operation, root.display()))?;
    let mut config = Config::default();
    config.global.set_root_path(&root_path);
    config.global.prefix =
        FileName::new(PREFIX.as_bytes()).map_err(middleware_error(operation, root.display()))?;
    // Only the learner cleans up, and only in `clean`: concurrent cleanups in iceoryx2 have known
    // bugs, and a process killed during cleanup leaves slots that are never freed.
    config.global.node.cleanup_dead_nodes_on_creation = false;
    config.global.node.cleanup_dead_nodes_on_destruction = false;
    config.global.service.cleanup_dead_nodes_on_open = false;
    let text = toml::to_string(&config).map_err(middleware_error(operation, root.display()))?;
    let file = root.join(CONFIG_FILE);
    std::fs::write(&file, text).map_err(middleware_error(operation, file.display()))
}

/// Registers this process as a node below `root`.
pub(super) fn join(root: &Path) -> Result<Node<PrivateIpc>, TransportError> {
    // Failures are returned as errors. The log only repeats them and reports every dead peer.
    set_log_level(LogLevel::Fatal);
    let file = root.join(CONFIG_FILE);
    let path = FilePath::new(file.as_os_str().as_encoded_bytes())
        .map_err(middleware_error("reading the configuration", file.display()))?;
    let config = Config::from_file(&path)
        .map_err(middleware_error("reading the configuration", file.display()))?;
    // The first call in a process stays in effect, even for other roots. This configuration is only
    // used to clean up after processes that died before they had recorded theirs.
    Config::setup_global_config_from_file(&path)
        .map_err(middleware_error("reading the configuration", file.display()))?;
    NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<PrivateIpc>()
        .map_err(middleware_error("joining", root.display()))
}

/// Frees the resources of dead processes below the node's root. Returns the number of nodes
/// scanned, dead or alive.
///
/// Calls `found_dead` for each dead node before any of its resources are removed. A dead process
/// sends no more data, so `found_dead` can take over all data that it left.
///
/// iceoryx2 0.10 panics if a node that it considered dead is alive (issue 1880). The panic is
/// returned as an error, and the next call retries.
pub(super) fn clean(
    node: &Node<PrivateIpc>,
    mut found_dead: impl FnMut(),
) -> Result<usize, TransportError> {
    let operation = "cleaning up after dead processes in";
    let cleaned = catch_unwind(AssertUnwindSafe(|| {
        let mut scanned = 0;
        let listed = Node::<PrivateIpc>::list(node.config(), |state| {
            scanned += 1;
            if let NodeState::Dead(dead) = state {
                found_dead();
                // The next call finds the files that could not be removed.
                let _ = dead.try_remove_stale_resources();
            }
            CallbackProgression::Continue
        });
        listed.map(|()| scanned)
    }));
    match cleaned {
        Ok(listed) => listed.map_err(middleware_error(operation, node.config().global.root_path())),
        Err(_) => {
            Err(middleware_error(operation, node.config().global.root_path())("iceoryx2 panicked"))
        }
    }
}
