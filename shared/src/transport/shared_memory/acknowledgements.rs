//! Acknowledgements from the learner to all workers.
//!
//! They are cumulative: each one replaces the previous one. If one is lost, workers only wait for
//! the next.

use std::fs::File;
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
use crate::transport::delivery::{Acknowledgements, Watermark};
use crate::transport::{AcknowledgementPublisher, AcknowledgementSubscriber, TransportError};

/// Numbers of a worker's mark: incarnation and sequence.
const NUMBERS_PER_WORKER: usize = 2;

/// Header of a sample.
#[derive(Debug, Default, Clone, Copy)]
#[repr(transparent)]
pub(super) struct WireHeader {
    /// Number of the learner that sent the sample.
    epoch: u64,
}

// SAFETY: one integer, no pointers, every bit pattern valid. The name must change with the layout.
unsafe impl ZeroCopySend for WireHeader {
    unsafe fn type_name() -> &'static str {
        "dmprl::AcknowledgementHeader1"
    }
}

/// Returns the length of a sample in numbers.
pub(super) fn sample_len(worker_count: usize) -> usize {
    worker_count * NUMBERS_PER_WORKER
}

fn channel(plan: &Plan) -> Channel {
    let mut agreement = plan.identity();
    agreement.push(("worker_count", plan.worker_count.to_string()));
    Channel { name: "acknowledgements".to_owned(), agreement }
}

/// The learner's end of the channel.
#[derive(Debug)]
pub struct Acknowledger {
    writer: Writer<u64, WireHeader>,
    epoch: u64,
    numbers: Vec<u64>,
}

impl Acknowledger {
    pub(super) fn serve(
        node: &Node<PrivateIpc>,
        plan: &Plan,
        epoch: u64,
        learner: Arc<File>,
    ) -> Result<Self, TransportError> {
        let len = sample_len(plan.worker_count);
        let writer = Writer::serve(node, channel(plan), len, plan.worker_count, learner)?;
        Ok(Self { writer, epoch, numbers: vec![0; len] })
    }
}

impl AcknowledgementPublisher for Acknowledger {
    fn acknowledge(&mut self, marks: &[Watermark]) -> Result<(), TransportError> {
        let (expected, got) = (self.numbers.len(), sample_len(marks.len()));
        if got != expected {
            return Err(TransportError::Length { expected, got });
        }
        for (numbers, mark) in self.numbers.chunks_exact_mut(NUMBERS_PER_WORKER).zip(marks) {
            numbers.copy_from_slice(&[mark.incarnation.into(), mark.sequence]);
        }
        self.writer.send(WireHeader { epoch: self.epoch }, &self.numbers)
    }

    fn maintain(&mut self) -> Result<(), TransportError> {
        self.writer.maintain()
    }
}

/// A worker's end of the channel.
#[derive(Debug)]
pub struct AcknowledgementReader {
    channel: Channel,
    membership: Membership<ReaderPort<u64, WireHeader>>,
    len: usize,
}

impl AcknowledgementReader {
    pub(super) fn attach(domain: &Domain, plan: &Plan) -> Result<Self, TransportError> {
        let channel = channel(plan);
        let membership =
            Membership::new(domain, |node, disconnected| subscribe(&channel, node, disconnected))?;
        Ok(Self { channel, membership, len: sample_len(plan.worker_count) })
    }
}

impl AcknowledgementSubscriber for AcknowledgementReader {
    fn newest(&mut self, acknowledgements: &mut Acknowledgements) -> Result<bool, TransportError> {
        let Self { channel, membership, len } = self;
        membership.renew(|node, disconnected| subscribe(channel, node, disconnected))?;
        let Some(port) = membership.port() else { return Ok(false) };
        let mut taken = false;
        for _ in 0..SAMPLES_MAX {
            let received =
                port.receive().map_err(middleware_error("receiving from", &channel.name))?;
            let Some(sample) = received else { break };
            // The length comes from the peer, so check it.
            let got = usize::try_from(sample.header().number_of_elements()).unwrap_or(usize::MAX);
            if got != *len {
                return Err(TransportError::Length { expected: *len, got });
            }
            acknowledgements.epoch = sample.user_header().epoch;
            acknowledgements.marks.clear();
            let marks =
                sample.payload().chunks_exact(NUMBERS_PER_WORKER).map(|numbers| Watermark {
                    // No worker has an incarnation this large, so nothing is acknowledged.
                    incarnation: u32::try_from(numbers[0]).unwrap_or(u32::MAX),
                    sequence: numbers[1],
                });
            acknowledgements.marks.extend(marks);
            taken = true;
        }
        Ok(taken)
    }
}
