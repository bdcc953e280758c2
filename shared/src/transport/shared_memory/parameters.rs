//! Policy snapshots from the learner to all workers. Each replaces the previous one.

use std::fs::{File, OpenOptions};
use std::os::unix::fs::{FileExt, OpenOptionsExt};
use std::sync::Arc;

use iceoryx2::node::Node;
use iceoryx2::prelude::PayloadHeader;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

use super::channel::Channel;
use super::domain::Domain;
use super::generation::Membership;
use super::latest::{ReaderPort, SAMPLES_MAX, Writer, subscribe};
use super::plan::Plan;
use super::service::{PrivateIpc, middleware_error};
use crate::parameters::{ParameterSnapshot, SnapshotError, checksum};
use crate::transport::{ParameterPublisher, ParameterSubscriber, TransportError};

/// File with the newest version that any learner of the domain has published.
const VERSION_FILE: &str = "policy_version";

/// Metadata of a snapshot.
#[derive(Debug, Default, Clone, Copy)]
#[repr(C)]
pub(super) struct WireHeader {
    version: u64,
    env_steps: u64,
    architecture_hash: u64,
    checksum: u32,
    /// 1 if the snapshot is settled, else 0.
    settled: u32,
}

const _: () = assert!(size_of::<WireHeader>() == 32 && align_of::<WireHeader>() == 8);

// SAFETY: integers only, no pointers. Size and alignment are asserted above. The name must change
// with the layout.
unsafe impl ZeroCopySend for WireHeader {
    unsafe fn type_name() -> &'static str {
        "dmprl::ParameterHeader2"
    }
}

impl WireHeader {
    /// Returns the fields that the checksum covers.
    fn fields(&self) -> [u64; 4] {
        [self.version, self.env_steps, self.architecture_hash, self.settled.into()]
    }
}

fn channel(plan: &Plan) -> Channel {
    let mut agreement = plan.identity();
    agreement.push(("parameters_len", plan.parameters_len.to_string()));
    Channel { name: "parameters".to_owned(), agreement }
}

/// The learner's end of the parameter channel.
#[derive(Debug)]
pub struct Publisher {
    writer: Writer<f32, WireHeader>,
    version_file: File,
    newest_version: u64,
}

impl Publisher {
    pub(super) fn serve(
        domain: &Domain,
        node: &Node<PrivateIpc>,
        plan: &Plan,
        learner: Arc<File>,
    ) -> Result<Self, TransportError> {
        let path = domain.path().join(VERSION_FILE);
        let version_file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .mode(0o600)
            .open(&path)
            .map_err(middleware_error("opening", path.display()))?;
        let mut bytes = [0; size_of::<u64>()];
        // The file is empty before the first publication.
        let newest_version =
            version_file.read_exact_at(&mut bytes, 0).map_or(0, |()| u64::from_le_bytes(bytes));
        let (len, worker_count) = (plan.parameters_len, plan.worker_count);
        let writer = Writer::serve(node, channel(plan), len, worker_count, learner)?;
        Ok(Self { writer, version_file, newest_version })
    }

    /// Returns the newest version published in this domain, by this learner or a previous one.
    ///
    /// A learner that resumes from a checkpoint must continue from this number, because workers
    /// ignore older versions and two policies must not have the same number.
    #[must_use]
    pub fn newest_version(&self) -> u64 {
        self.newest_version
    }
}

impl ParameterPublisher for Publisher {
    fn publish(&mut self, snapshot: &ParameterSnapshot) -> Result<(), TransportError> {
        let header = WireHeader {
            version: snapshot.version,
            env_steps: snapshot.env_steps,
            architecture_hash: snapshot.architecture_hash,
            checksum: snapshot.checksum(),
            settled: snapshot.settled.into(),
        };
        // Written before publication, so that a restarted learner knows every published version.
        self.version_file
            .write_all_at(&snapshot.version.to_le_bytes(), 0)
            .map_err(middleware_error("writing", VERSION_FILE))?;
        self.newest_version = snapshot.version;
        self.writer.send(header, &snapshot.values)
    }

    fn maintain(&mut self) -> Result<(), TransportError> {
        self.writer.maintain()
    }
}

/// A reader's end of the parameter channel.
#[derive(Debug)]
pub struct Subscriber {
    channel: Channel,
    membership: Membership<ReaderPort<f32, WireHeader>>,
    architecture_hash: u64,
    /// Values of the snapshot that is being checked. They are copied before they are checked, since
    /// a faulty peer could change them in shared memory between the check and the copy.
    copied: Vec<f32>,
}

impl Subscriber {
    pub(super) fn attach(domain: &Domain, plan: &Plan) -> Result<Self, TransportError> {
        let channel = channel(plan);
        let membership =
            Membership::new(domain, |node, disconnected| subscribe(&channel, node, disconnected))?;
        let copied = vec![0.0; plan.parameters_len];
        Ok(Self { channel, membership, architecture_hash: plan.architecture_hash, copied })
    }
}

/// Rejects a corrupted snapshot, or one of another architecture.
fn check(header: &WireHeader, values: &[f32], architecture_hash: u64) -> Result<(), SnapshotError> {
    let version = header.version;
    let (expected, got) = (architecture_hash, header.architecture_hash);
    if got != expected {
        return Err(SnapshotError::Architecture { version, expected, got });
    }
    let expected = header.checksum;
    let got = checksum(header.fields(), values);
    if got != expected {
        return Err(SnapshotError::Checksum { version, expected, got });
    }
    Ok(())
}

impl ParameterSubscriber for Subscriber {
    fn newest(&mut self, snapshot: &mut ParameterSnapshot) -> Result<bool, TransportError> {
        let Self { channel, membership, copied, .. } = self;
        membership.renew(|node, disconnected| subscribe(channel, node, disconnected))?;
        let Some(port) = membership.port() else { return Ok(false) };
        let mut replaced = false;
        for _ in 0..SAMPLES_MAX {
            let received =
                port.receive().map_err(middleware_error("receiving from", &channel.name))?;
            let Some(sample) = received else { break };
            // The length comes from the peer, so check it.
            let got = usize::try_from(sample.header().number_of_elements()).unwrap_or(usize::MAX);
            if got != copied.len() {
                return Err(TransportError::Length { expected: copied.len(), got });
            }
            let header = *sample.user_header();
            if header.version <= snapshot.version {
                continue;
            }
            copied.copy_from_slice(sample.payload());
            check(&header, copied, self.architecture_hash)?;
            snapshot.version = header.version;
            snapshot.env_steps = header.env_steps;
            snapshot.architecture_hash = header.architecture_hash;
            snapshot.settled = header.settled != 0;
            snapshot.values.clone_from(copied);
            replaced = true;
        }
        Ok(replaced)
    }

    fn epoch(&self) -> u64 {
        self.membership.number()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::segment::SegmentLayout;
    use crate::transport::shared_memory::{Domain, serve, subscribe};

    #[test]
    fn a_damaged_snapshot_is_refused_and_changes_nothing() {
        let directory = tempfile::tempdir().unwrap();
        let domain = Domain::create(&directory.path().join("p"), "run").unwrap();
        let plan = Plan {
            run_id: 1,
            architecture_hash: 2,
            layout: SegmentLayout { segment_steps: 1, observation_len: 1, action_len: 1 },
            worker_count: 1,
            queue_segments: 1,
            parameters_len: 3,
        };
        let mut learner = serve(domain.path(), &plan).unwrap();
        let mut subscriber = subscribe(domain.path(), &plan).unwrap();
        let valid = ParameterSnapshot {
            version: 1,
            env_steps: 10,
            architecture_hash: 2,
            settled: true,
            values: vec![1.0, 2.0, 3.0],
        };
        learner.parameters.publish(&valid).unwrap();
        let mut taken = ParameterSnapshot::default();
        assert!(subscriber.newest(&mut taken).unwrap());
        let header = WireHeader {
            version: 2,
            env_steps: 20,
            architecture_hash: 2,
            checksum: checksum([2, 20, 2, 1], &[1.0, 2.0, 3.0]),
            settled: 1,
        };
        learner.parameters.writer.send(header, &[1.0, 2.0, 4.0]).unwrap();
        let error = subscriber.newest(&mut taken).unwrap_err();
        let TransportError::Snapshot(SnapshotError::Checksum { version, expected, got }) = error
        else {
            panic!("{error}");
        };
        assert_eq!((version, expected), (2, header.checksum));
        assert_ne!(got, expected);
        assert_eq!(taken, valid);
    }
}
