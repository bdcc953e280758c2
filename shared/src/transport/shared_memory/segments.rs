//! Segment queues from workers to the learner, one per worker slot.
//!
//! Each worker has its own service, because a subscriber with several publishers serves them in a
//! fixed order and would starve the last. The learner serves the queues in turn.

use std::fs::File;
use std::sync::Arc;

use iceoryx2::node::Node;
use iceoryx2::port::publisher::{Publisher as Port, PublisherCreateError};
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::{BackpressureAction, BackpressureInfo, SendError};
use iceoryx2::prelude::PayloadHeader;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

use super::channel::{Channel, ChannelBuilder, Disconnected, Factory};
use super::cleaning::{Cleaning, sender_died};
use super::domain::Domain;
use super::generation::Membership;
use super::plan::Plan;
use super::service::{PrivateIpc, middleware_error};
use crate::segment::{LAYOUT_VERSION, Segment, SegmentHeader};
use crate::transport::{SegmentReceiver, SegmentSender, SendOutcome, TransportError};

/// Segments received from one worker before the next worker's turn. It is more than one, so that a
/// learner with many idle workers does not poll all of them for each segment.
const TURN_SEGMENTS: usize = 8;
/// Maximum number of processes that have one worker's service open: learner, worker, and dead
/// processes that are not cleaned up yet.
const NODES_MAX: usize = 8;
/// Chunks that the learner borrows. One is enough, because it copies a segment and returns the
/// chunk immediately.
const BORROWED_MAX: usize = 1;

/// [`SegmentHeader`] in shared memory. Its name identifies the layout to peers of other builds.
#[derive(Debug, Default, Clone, Copy)]
#[repr(transparent)]
pub(super) struct WireHeader(pub(super) SegmentHeader);

// SAFETY: `SegmentHeader` is `Pod`: no pointers, no padding, every bit pattern valid. Its
// definition asserts size and alignment, and peers compare its layout version.
unsafe impl ZeroCopySend for WireHeader {
    unsafe fn type_name() -> &'static str {
        "dmprl::SegmentHeader"
    }
}

/// Returns the number of chunks in a worker's data segment: queued, borrowed and being filled.
pub(super) fn chunk_count(queue_segments: usize) -> usize {
    queue_segments + BORROWED_MAX + 1
}

fn channel(plan: &Plan, worker_index: usize) -> Channel {
    let mut agreement = plan.identity();
    agreement.extend([
        ("segment_header", LAYOUT_VERSION.to_string()),
        ("segment_steps", plan.layout.segment_steps.to_string()),
        ("observation_len", plan.layout.observation_len.to_string()),
        ("action_len", plan.layout.action_len.to_string()),
    ]);
    Channel { name: format!("segments/{worker_index}"), agreement }
}

type SenderPort = Port<PrivateIpc, [f32], WireHeader>;
type ReceiverPort = Subscriber<PrivateIpc, [f32], WireHeader>;

/// A worker's end of its queue.
#[derive(Debug)]
pub struct Sender {
    channel: Channel,
    membership: Membership<SenderPort>,
    block_len: usize,
}

impl Sender {
    pub(super) fn attach(
        domain: &Domain,
        plan: &Plan,
        worker_index: usize,
    ) -> Result<Self, TransportError> {
        let channel = channel(plan, worker_index);
        let block_len = plan.layout.block_len();
        let membership = Membership::new(domain, |node, disconnected| {
            publish(&channel, node, block_len, disconnected)
        })?;
        Ok(Self { channel, membership, block_len })
    }
}

fn publish(
    channel: &Channel,
    node: &Node<PrivateIpc>,
    block_len: usize,
    disconnected: &Disconnected,
) -> Result<SenderPort, TransportError> {
    let port = channel
        .open(node)?
        .publisher_builder()
        .initial_max_slice_len(block_len)
        .max_loaned_samples(1)
        // By default iceoryx2 blocks on a full queue, even forever if the learner is dead.
        .set_backpressure_handler(|_: &BackpressureInfo| BackpressureAction::DiscardDataAndFail)
        .set_degradation_handler(disconnected.handler())
        .create();
    port.map_err(|cause| match cause {
        PublisherCreateError::ExceedsMaxSupportedPublishers => channel.taken(cause),
        cause => middleware_error("creating a port of", &channel.name)(cause),
    })
}

impl SegmentSender for Sender {
    fn renew(&mut self) -> Result<bool, TransportError> {
        let Self { channel, membership, block_len } = self;
        membership.renew(|node, disconnected| publish(channel, node, *block_len, disconnected))
    }

    fn try_send(
        &mut self,
        header: &SegmentHeader,
        block: &[f32],
    ) -> Result<SendOutcome, TransportError> {
        if block.len() != self.block_len {
            return Err(TransportError::Length { expected: self.block_len, got: block.len() });
        }
        let Self { channel, membership, .. } = self;
        let Some(port) = membership.port() else { return Ok(SendOutcome::Detached) };
        let sent = port.loan_slice_uninit(block.len()).map(|mut sample| {
            *sample.user_header_mut() = WireHeader(*header);
            sample.write_from_slice(block).send()
        });
        match sent {
            // No learner received the sample, and iceoryx2 has dropped it.
            Ok(Ok(0)) => Ok(SendOutcome::Detached),
            Ok(Ok(_)) => Ok(SendOutcome::Delivered),
            Ok(Err(SendError::UnableToDeliver)) => Ok(SendOutcome::Full),
            Ok(Err(cause)) => Err(middleware_error("sending to", &channel.name)(cause)),
            Err(cause) => Err(middleware_error("sending to", &channel.name)(cause)),
        }
    }
}

/// The learner's end of one worker's queue.
#[derive(Debug)]
struct Slot {
    channel: Channel,
    factory: Factory<f32, WireHeader>,
    /// `None` only after a port could not be recreated.
    port: Option<ReceiverPort>,
    disconnected: Disconnected,
}

/// The learner's end of all queues.
#[derive(Debug)]
pub struct Receiver {
    slots: Vec<Slot>,
    next: usize,
    turn_left: usize,
    block_len: usize,
    node: Node<PrivateIpc>,
    cleaning: Cleaning,
    /// The learner's lock, which prevents a second learner. It is the last field, so that it is
    /// released after the ports.
    _learner: Arc<File>,
}

impl Receiver {
    pub(super) fn serve(
        node: Node<PrivateIpc>,
        plan: &Plan,
        learner: Arc<File>,
    ) -> Result<Self, TransportError> {
        let slots = (0..plan.worker_count).map(|index| Slot::serve(&node, plan, index));
        let slots = slots.collect::<Result<Vec<_>, _>>()?;
        let block_len = plan.layout.block_len();
        let turn_left = TURN_SEGMENTS;
        Ok(Self {
            slots,
            next: 0,
            turn_left,
            block_len,
            node,
            cleaning: Cleaning::default(),
            _learner: learner,
        })
    }

    /// Like [`SegmentReceiver::try_receive`], but receives only from the queue of one worker. The
    /// other workers wait once their queues are full.
    ///
    /// # Errors
    /// `Middleware` if the queue is broken.
    ///
    /// # Panics
    /// If the worker does not exist.
    pub fn try_receive_from(
        &mut self,
        worker_index: usize,
        segment: &mut Segment,
    ) -> Result<bool, TransportError> {
        self.slots[worker_index].receive(segment, self.block_len)
    }

    fn pass_turn(&mut self) {
        self.next = (self.next + 1) % self.slots.len();
        self.turn_left = TURN_SEGMENTS;
    }
}

impl Slot {
    fn serve(
        node: &Node<PrivateIpc>,
        plan: &Plan,
        worker_index: usize,
    ) -> Result<Self, TransportError> {
        let channel = channel(plan, worker_index);
        let factory = channel.create(node, |builder: ChannelBuilder<f32, WireHeader>| {
            builder
                .enable_safe_overflow(false)
                .history_size(0)
                .subscriber_max_buffer_size(plan.queue_segments)
                .subscriber_max_borrowed_samples(BORROWED_MAX)
                .max_publishers(1)
                .max_subscribers(1)
                .max_nodes(NODES_MAX)
        })?;
        let disconnected = Disconnected::default();
        let port = Some(subscribe(&channel, &factory, &disconnected)?);
        Ok(Self { channel, factory, port, disconnected })
    }

    fn receive(&self, segment: &mut Segment, block_len: usize) -> Result<bool, TransportError> {
        let Some(port) = &self.port else { return Ok(false) };
        let received =
            port.receive().map_err(middleware_error("receiving from", &self.channel.name))?;
        let Some(sample) = received else { return Ok(false) };
        // The length comes from the peer, so check it.
        let got = usize::try_from(sample.header().number_of_elements()).unwrap_or(usize::MAX);
        if got != block_len {
            return Err(TransportError::Length { expected: block_len, got });
        }
        segment.header = sample.user_header().0;
        segment.block.resize(block_len, 0.0);
        segment.block.copy_from_slice(sample.payload());
        Ok(true)
    }

    /// Recreates the port after a failed connection, but not while the old one still has segments.
    fn renew(&mut self) -> Result<(), TransportError> {
        let waiting = |port: &ReceiverPort| port.has_samples().unwrap_or(false);
        let needed = self.disconnected.is_set() || self.port.is_none();
        if !needed || self.port.as_ref().is_some_and(waiting) {
            return Ok(());
        }
        self.disconnected.clear();
        self.port = None;
        self.port = Some(subscribe(&self.channel, &self.factory, &self.disconnected)?);
        Ok(())
    }
}

fn subscribe(
    channel: &Channel,
    factory: &Factory<f32, WireHeader>,
    disconnected: &Disconnected,
) -> Result<ReceiverPort, TransportError> {
    factory
        .subscriber_builder()
        .set_degradation_handler(disconnected.handler())
        .create()
        .map_err(middleware_error("creating a port of", &channel.name))
}

impl SegmentReceiver for Receiver {
    fn try_receive(&mut self, segment: &mut Segment) -> Result<bool, TransportError> {
        if self.turn_left == 0 {
            self.pass_turn();
        }
        for _ in 0..self.slots.len() {
            if self.slots[self.next].receive(segment, self.block_len)? {
                self.turn_left -= 1;
                return Ok(true);
            }
            self.pass_turn();
        }
        Ok(false)
    }

    fn maintain(&mut self) -> Result<(), TransportError> {
        let Self { slots, cleaning, node, .. } = self;
        let died = slots.iter().any(|slot| sender_died(&slot.factory));
        // Connects to dead workers before their cleanup, because the cleanup discards the delivered
        // segments of a worker to which the learner never connected. Connecting before a scan has
        // found dead workers would miss a worker that starts, sends and dies in between.
        let connect = || {
            for port in slots.iter().filter_map(|slot| slot.port.as_ref()) {
                let _ = port.has_samples();
            }
        };
        cleaning.clean_if_due(node, died, connect)?;
        self.slots.iter_mut().try_for_each(Slot::renew)
    }
}

#[cfg(test)]
mod tests {
    use crate::segment::{Segment, SegmentHeader, SegmentLayout};
    use crate::transport::shared_memory::{Domain, Plan, attach, serve};
    use crate::transport::{SegmentReceiver, SegmentSender, SendOutcome, TransportError};

    fn plan(worker_count: usize) -> Plan {
        Plan {
            run_id: 1,
            architecture_hash: 2,
            layout: SegmentLayout { segment_steps: 5, observation_len: 3, action_len: 2 },
            worker_count,
            queue_segments: 4,
            parameters_len: 1,
        }
    }

    #[test]
    fn one_worker_is_taken_from_while_the_others_wait_on_their_full_queues() {
        let directory = tempfile::tempdir().unwrap();
        let domain = Domain::create(&directory.path().join("p"), "run").unwrap();
        let plan = plan(2);
        let mut learner = serve(domain.path(), &plan).unwrap();
        let mut workers = [0, 1].map(|index| attach(domain.path(), &plan, index).unwrap().segments);
        let block = vec![0.0; plan.layout.block_len()];
        let mut send = |worker: usize, sequence| {
            let header =
                SegmentHeader { sequence, worker_id: worker as u32, ..SegmentHeader::default() };
            workers[worker].try_send(&header, &block).unwrap()
        };
        let mut segment = Segment::zeroed(plan.layout);
        // The learner connects to a queue on its first poll. Before that, a full queue drops
        // segments.
        assert_eq!(send(0, 0), SendOutcome::Delivered);
        assert!(learner.segments.try_receive(&mut segment).unwrap());
        let all_delivered = [SendOutcome::Delivered; 4];
        assert_eq!([1, 2, 3, 4].map(|sequence| send(0, sequence)), all_delivered);
        for sequence in 1..=10 {
            assert_eq!(send(1, sequence), SendOutcome::Delivered);
            assert!(learner.segments.try_receive_from(1, &mut segment).unwrap());
            assert_eq!((segment.header.worker_id, segment.header.sequence), (1, sequence));
            assert!(!learner.segments.try_receive_from(1, &mut segment).unwrap());
            assert_eq!(send(0, 5), SendOutcome::Full);
        }
        // All segments of the other worker are still there.
        for sequence in 1..=4 {
            assert!(learner.segments.try_receive(&mut segment).unwrap());
            assert_eq!((segment.header.worker_id, segment.header.sequence), (0, sequence));
        }
    }

    #[test]
    fn a_segment_whose_length_the_peer_got_wrong_is_refused_before_it_is_read() {
        let directory = tempfile::tempdir().unwrap();
        let domain = Domain::create(&directory.path().join("p"), "run").unwrap();
        let plan = plan(1);
        let layout = plan.layout;
        let mut learner = serve(domain.path(), &plan).unwrap();
        let mut worker = attach(domain.path(), &plan, 0).unwrap().segments;
        let len = layout.block_len();
        let block = vec![1.0; len];
        let send = |worker: &mut super::Sender, len: usize| {
            worker.block_len = len;
            let sent = worker.try_send(&SegmentHeader::default(), &block[..len]).unwrap();
            assert_eq!(sent, SendOutcome::Delivered);
        };
        send(&mut worker, len - 1);
        send(&mut worker, len);
        let mut segment = Segment::zeroed(layout);
        let error = learner.segments.try_receive(&mut segment).unwrap_err();
        let TransportError::Length { expected, got } = error else { panic!("{error}") };
        assert_eq!((expected, got), (len, len - 1));
        assert_eq!(segment, Segment::zeroed(layout));
        assert!(learner.segments.try_receive(&mut segment).unwrap());
        assert_eq!(segment.block, block);
    }
}
