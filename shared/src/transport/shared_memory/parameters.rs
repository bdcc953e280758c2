//! Policy snapshots from the learner to all workers: the newest replaces the one before.

use std::fs::File;
use std::sync::Arc;

use iceoryx2::node::Node;
use iceoryx2::port::publisher::Publisher as Port;
use iceoryx2::port::subscriber::SubscriberCreateError;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::PayloadHeader;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

use super::Plan;
use super::channel::{Channel, ChannelBuilder, Disconnected, Factory};
use super::domain::Domain;
use super::generation::Membership;
use super::service::{PrivateIpc, refused};
use crate::parameters::{ParameterSnapshot, SnapshotError, checksum};
use crate::transport::{ParameterPublisher, ParameterSubscriber, TransportError};

/// Readers besides the workers: evaluator, dashboard, and the dead that are not cleaned up yet.
const SPARE_SUBSCRIBERS: usize = 4;
/// Processes besides the readers, likewise.
const SPARE_NODES: usize = 4;
/// Snapshots taken from the channel in one call: the newest, and one more if the learner had to
/// make a new port.
const SNAPSHOTS_MAX: usize = 2;

/// Everything about a snapshot except its values.
#[derive(Debug, Default, Clone, Copy)]
#[repr(C)]
pub(super) struct WireHeader {
    version: u64,
    env_steps: u64,
    architecture_hash: u64,
    checksum: u32,
    /// Fills the last word.
    reserved: u32,
}

const _: () = assert!(size_of::<WireHeader>() == 32 && align_of::<WireHeader>() == 8);

// SAFETY: integers only, no pointers; size and alignment are asserted above. A change of the layout
// changes the name.
unsafe impl ZeroCopySend for WireHeader {
    unsafe fn type_name() -> &'static str {
        "dmprl::ParameterHeader1"
    }
}

/// Chunks in the learner's data segment: the newest, the one being filled, and one that each
/// reader may still be copying. Pages that are never written cost nothing.
pub(super) fn chunk_count(worker_count: usize) -> usize {
    worker_count + SPARE_SUBSCRIBERS + 2
}

fn channel(plan: &Plan) -> Channel {
    let mut agreement = plan.identity();
    agreement.push(("parameters_len", plan.parameters_len.to_string()));
    Channel { name: "parameters".to_owned(), agreement }
}

/// The learner's end of the parameter channel.
#[derive(Debug)]
pub struct Publisher {
    channel: Channel,
    factory: Factory<WireHeader>,
    /// `None` only after a new port could not be made.
    port: Option<Port<PrivateIpc, [f32], WireHeader>>,
    disconnected: Disconnected,
    parameters_len: usize,
    chunk_count: usize,
    /// Says to a second learner that there is one. Last: given up after the port.
    _learner: Arc<File>,
}

impl Publisher {
    pub(super) fn serve(
        node: &Node<PrivateIpc>,
        plan: &Plan,
        learner: Arc<File>,
    ) -> Result<Self, TransportError> {
        let channel = channel(plan);
        let subscribers_max = plan.worker_count + SPARE_SUBSCRIBERS;
        let factory = channel.create(node, |builder: ChannelBuilder<WireHeader>| {
            builder
                .enable_safe_overflow(true)
                .history_size(1)
                .subscriber_max_buffer_size(1)
                .subscriber_max_borrowed_samples(1)
                .max_publishers(1)
                .max_subscribers(subscribers_max)
                .max_nodes(subscribers_max + SPARE_NODES)
        })?;
        let mut publisher = Self {
            channel,
            factory,
            port: None,
            disconnected: Disconnected::default(),
            parameters_len: plan.parameters_len,
            chunk_count: chunk_count(plan.worker_count),
            _learner: learner,
        };
        publisher.renew()?;
        Ok(publisher)
    }

    /// A new port, at the start and after a connection failed.
    fn renew(&mut self) -> Result<(), TransportError> {
        self.disconnected.clear();
        self.port = None;
        let chunk_count = self.chunk_count;
        let port = self
            .factory
            .publisher_builder()
            .initial_max_slice_len(self.parameters_len)
            .max_loaned_samples(1)
            .override_sample_preallocation(move |worst_case| worst_case.min(chunk_count))
            .set_degradation_handler(self.disconnected.remember())
            .create()
            .map_err(refused("making a port of", &self.channel.name))?;
        self.port = Some(port);
        Ok(())
    }

    fn port(&self) -> Result<&Port<PrivateIpc, [f32], WireHeader>, TransportError> {
        self.port.as_ref().ok_or_else(|| refused("publishing on", &self.channel.name)("no port"))
    }

    fn send(&self, header: WireHeader, values: &[f32]) -> Result<(), TransportError> {
        let name = &self.channel.name;
        let mut sample = self
            .port()?
            .loan_slice_uninit(values.len())
            .map_err(refused("taking shared memory for", name))?;
        *sample.user_header_mut() = header;
        let sent = sample.write_from_slice(values).send();
        sent.map(|_workers| ()).map_err(refused("publishing on", name))
    }
}

impl ParameterPublisher for Publisher {
    fn publish(&mut self, snapshot: &ParameterSnapshot) -> Result<(), TransportError> {
        let (expected, got) = (self.parameters_len, snapshot.values.len());
        if got != expected {
            return Err(TransportError::Length { expected, got });
        }
        let header = WireHeader {
            version: snapshot.version,
            env_steps: snapshot.env_steps,
            architecture_hash: snapshot.architecture_hash,
            checksum: snapshot.checksum(),
            reserved: 0,
        };
        self.send(header, &snapshot.values)
    }

    /// Hands the newest snapshot to workers that have joined since. After a connection failed, a
    /// new port takes over, and late joiners wait for the next snapshot.
    fn maintain(&mut self) -> Result<(), TransportError> {
        if self.disconnected.is_set() || self.port.is_none() {
            self.renew()?;
        }
        self.port()?.update_connections().map_err(refused("connecting", &self.channel.name))
    }
}

type SubscriberPort = iceoryx2::port::subscriber::Subscriber<PrivateIpc, [f32], WireHeader>;

/// A reader's end of the parameter channel.
#[derive(Debug)]
pub struct Subscriber {
    channel: Channel,
    membership: Membership<SubscriberPort>,
    parameters_len: usize,
    architecture_hash: u64,
}

impl Subscriber {
    pub(super) fn attach(domain: &Domain, plan: &Plan) -> Result<Self, TransportError> {
        let channel = channel(plan);
        let membership =
            Membership::new(domain, |node, disconnected| subscribe(&channel, node, disconnected))?;
        let Plan { parameters_len, architecture_hash, .. } = *plan;
        Ok(Self { channel, membership, parameters_len, architecture_hash })
    }
}

fn subscribe(
    channel: &Channel,
    node: &Node<PrivateIpc>,
    disconnected: &Disconnected,
) -> Result<SubscriberPort, TransportError> {
    let port = channel
        .open(node)?
        .subscriber_builder()
        .set_degradation_handler(disconnected.remember())
        .create();
    port.map_err(|cause| match cause {
        SubscriberCreateError::ExceedsMaxSupportedSubscribers => channel.taken(cause),
        cause => refused("making a port of", &channel.name)(cause),
    })
}

/// Refuses a snapshot that is foreign or damaged.
fn check(header: &WireHeader, values: &[f32], architecture_hash: u64) -> Result<(), SnapshotError> {
    let version = header.version;
    let (expected, got) = (architecture_hash, header.architecture_hash);
    if got != expected {
        return Err(SnapshotError::Architecture { version, expected, got });
    }
    let expected = header.checksum;
    let got = checksum(version, header.env_steps, header.architecture_hash, values);
    if got != expected {
        return Err(SnapshotError::Checksum { version, expected, got });
    }
    Ok(())
}

impl ParameterSubscriber for Subscriber {
    fn newest(&mut self, snapshot: &mut ParameterSnapshot) -> Result<bool, TransportError> {
        let Self { channel, membership, .. } = self;
        let port = membership.port(|node, disconnected| subscribe(channel, node, disconnected))?;
        let Some(port) = port else { return Ok(false) };
        let mut replaced = false;
        for _ in 0..SNAPSHOTS_MAX {
            let received = port.receive().map_err(refused("receiving from", &channel.name))?;
            let Some(sample) = received else { break };
            // The length is the peer's word: believed only if it is the agreed one.
            let got = usize::try_from(sample.header().number_of_elements()).unwrap_or(usize::MAX);
            if got != self.parameters_len {
                return Err(TransportError::Length { expected: self.parameters_len, got });
            }
            let header = *sample.user_header();
            if header.version <= snapshot.version {
                continue;
            }
            check(&header, sample.payload(), self.architecture_hash)?;
            snapshot.version = header.version;
            snapshot.env_steps = header.env_steps;
            snapshot.architecture_hash = header.architecture_hash;
            snapshot.values.resize(self.parameters_len, 0.0);
            snapshot.values.copy_from_slice(sample.payload());
            replaced = true;
        }
        Ok(replaced)
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
        let sound = ParameterSnapshot {
            version: 1,
            env_steps: 10,
            architecture_hash: 2,
            values: vec![1.0, 2.0, 3.0],
        };
        learner.parameters.publish(&sound).unwrap();
        let mut taken = ParameterSnapshot::default();
        assert!(subscriber.newest(&mut taken).unwrap());
        let header = WireHeader {
            version: 2,
            env_steps: 20,
            architecture_hash: 2,
            checksum: checksum(2, 20, 2, &[1.0, 2.0, 3.0]),
            reserved: 0,
        };
        learner.parameters.send(header, &[1.0, 2.0, 4.0]).unwrap();
        let refusal = subscriber.newest(&mut taken).unwrap_err();
        let TransportError::Snapshot(SnapshotError::Checksum { version, expected, got }) = refusal
        else {
            panic!("{refusal}");
        };
        assert_eq!((version, expected), (2, header.checksum));
        assert_ne!(got, expected);
        assert_eq!(taken, sound);
    }
}
