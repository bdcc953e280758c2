//! A channel from the learner to many readers, in which each sample replaces the previous one.

use std::fmt::Debug;
use std::fs::File;
use std::sync::Arc;

use iceoryx2::node::Node;
use iceoryx2::port::publisher::Publisher as Port;
use iceoryx2::port::subscriber::{Subscriber, SubscriberCreateError};
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

use super::channel::{Channel, ChannelBuilder, Disconnected, Factory};
use super::service::{PrivateIpc, middleware_error};
use crate::transport::TransportError;

/// Readers besides the workers: evaluator, dashboard, and dead readers that are not cleaned up yet.
const SPARE_SUBSCRIBERS: usize = 4;
/// Processes besides the readers, such as dead ones that are not cleaned up yet.
const SPARE_NODES: usize = 4;
/// Maximum number of samples read per call: the newest, and one more if the learner has recreated
/// its port.
pub(super) const SAMPLES_MAX: usize = 2;

/// Returns the number of chunks in the learner's data segment: the newest, the one being filled,
/// and one per reader, which the reader may still be copying. Unwritten pages take no memory.
pub(super) fn chunk_count(worker_count: usize) -> usize {
    worker_count + SPARE_SUBSCRIBERS + 2
}

/// A reader's port.
pub(super) type ReaderPort<E, H> = Subscriber<PrivateIpc, [E], H>;

/// The learner's end of the channel.
#[derive(Debug)]
pub(super) struct Writer<E, H>
where
    E: Copy + Debug + ZeroCopySend + 'static,
    H: Debug + ZeroCopySend,
{
    channel: Channel,
    factory: Factory<E, H>,
    /// `None` only after a port could not be recreated.
    port: Option<Port<PrivateIpc, [E], H>>,
    disconnected: Disconnected,
    len: usize,
    chunk_count: usize,
    /// The learner's lock, which prevents a second learner. It is the last field, so that it is
    /// released after the port.
    _learner: Arc<File>,
}

impl<E, H> Writer<E, H>
where
    E: Copy + Debug + ZeroCopySend + 'static,
    H: Debug + Default + ZeroCopySend,
{
    /// Creates the channel, whose samples have `len` elements.
    pub(super) fn serve(
        node: &Node<PrivateIpc>,
        channel: Channel,
        len: usize,
        worker_count: usize,
        learner: Arc<File>,
    ) -> Result<Self, TransportError> {
        let subscribers_max = worker_count + SPARE_SUBSCRIBERS;
        let factory = channel.create(node, |builder: ChannelBuilder<E, H>| {
            builder
                .enable_safe_overflow(true)
                .history_size(1)
                .subscriber_max_buffer_size(1)
                .subscriber_max_borrowed_samples(1)
                .max_publishers(1)
                .max_subscribers(subscribers_max)
                .max_nodes(subscribers_max + SPARE_NODES)
        })?;
        let mut writer = Self {
            channel,
            factory,
            port: None,
            disconnected: Disconnected::default(),
            len,
            chunk_count: chunk_count(worker_count),
            _learner: learner,
        };
        writer.renew()?;
        Ok(writer)
    }

    /// Creates the port, or recreates it after a failed connection.
    fn renew(&mut self) -> Result<(), TransportError> {
        self.disconnected.clear();
        self.port = None;
        let chunk_count = self.chunk_count;
        let port = self
            .factory
            .publisher_builder()
            .initial_max_slice_len(self.len)
            .max_loaned_samples(1)
            .override_sample_preallocation(move |worst_case| worst_case.min(chunk_count))
            .set_degradation_handler(self.disconnected.handler())
            .create()
            .map_err(middleware_error("creating a port of", &self.channel.name))?;
        self.port = Some(port);
        Ok(())
    }

    fn port(&self) -> Result<&Port<PrivateIpc, [E], H>, TransportError> {
        self.port
            .as_ref()
            .ok_or_else(|| middleware_error("publishing on", &self.channel.name)("no port"))
    }

    /// Replaces the newest sample.
    pub(super) fn send(&self, header: H, values: &[E]) -> Result<(), TransportError> {
        let (expected, got) = (self.len, values.len());
        if got != expected {
            return Err(TransportError::Length { expected, got });
        }
        let name = &self.channel.name;
        let mut sample = self
            .port()?
            .loan_slice_uninit(values.len())
            .map_err(middleware_error("allocating shared memory for", name))?;
        *sample.user_header_mut() = header;
        let sent = sample.write_from_slice(values).send();
        sent.map(|_readers| ()).map_err(middleware_error("publishing on", name))
    }

    /// Sends the newest sample to readers that have joined since. After a failed connection it
    /// recreates the port, and new readers wait for the next sample.
    pub(super) fn maintain(&mut self) -> Result<(), TransportError> {
        if self.disconnected.is_set() || self.port.is_none() {
            self.renew()?;
        }
        self.port()?
            .update_connections()
            .map_err(middleware_error("updating the connections of", &self.channel.name))
    }
}

/// Joins the channel as a reader.
pub(super) fn subscribe<E, H>(
    channel: &Channel,
    node: &Node<PrivateIpc>,
    disconnected: &Disconnected,
) -> Result<ReaderPort<E, H>, TransportError>
where
    E: Debug + ZeroCopySend + 'static,
    H: Debug + ZeroCopySend,
{
    let port = channel
        .open(node)?
        .subscriber_builder()
        .set_degradation_handler(disconnected.handler())
        .create();
    port.map_err(|cause| match cause {
        SubscriberCreateError::ExceedsMaxSupportedSubscribers => channel.taken(cause),
        cause => middleware_error("creating a port of", &channel.name)(cause),
    })
}
