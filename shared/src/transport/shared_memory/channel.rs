//! An iceoryx2 service with attributes that its peers compare. The learner creates it, and workers
//! open it.

use std::fmt::Debug;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use iceoryx2::node::Node;
use iceoryx2::port::DegradationAction;
use iceoryx2::prelude::{MessagingPattern, ZeroCopySend};
use iceoryx2::service::Service;
use iceoryx2::service::attribute::{
    AttributeKey, AttributeSpecifier, AttributeValue, AttributeVerifier,
};
use iceoryx2::service::builder::publish_subscribe::{
    Builder, PublishSubscribeOpenError as OpenError,
};
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

use super::service::{PrivateIpc, middleware_error, service_name};
use crate::transport::TransportError;

/// Creates the ports of one service whose samples are slices of `E` with a header `H`.
///
/// The elements are plain numbers, not 64-byte blocks. The slice's length is then the block's
/// length, so a wrong length is detected before the payload is read. Copying does not need a larger
/// alignment.
pub(super) type Factory<E, H> = PortFactory<PrivateIpc, [E], H>;
/// A service before it is created or opened.
pub(super) type ChannelBuilder<E, H> = Builder<[E], H, PrivateIpc>;

/// A service's name, and the attributes that must be equal in all peers.
#[derive(Debug, Clone)]
pub(super) struct Channel {
    pub(super) name: String,
    /// Name and value of each attribute.
    pub(super) agreement: Vec<(&'static str, String)>,
}

impl Channel {
    /// Creates the service. The learner calls this, in a directory of its own.
    pub(super) fn create<E, H>(
        &self,
        node: &Node<PrivateIpc>,
        limits: impl FnOnce(ChannelBuilder<E, H>) -> ChannelBuilder<E, H>,
    ) -> Result<Factory<E, H>, TransportError>
    where
        E: Debug + ZeroCopySend + 'static,
        H: Debug + ZeroCopySend,
    {
        let mut attributes = AttributeSpecifier::new();
        for (key, value) in &self.agreement {
            let (key, value) = attribute(key, value)?;
            attributes = attributes
                .define(&key, &value)
                .map_err(middleware_error("defining the attribute", key))?;
        }
        limits(self.builder(node)?)
            .create_with_attributes(&attributes)
            .map_err(middleware_error("creating the service", &self.name))
    }

    /// Opens the service that the learner created. A worker never creates one: if it were killed
    /// meanwhile, every process that opens the incomplete service would hang.
    pub(super) fn open<E, H>(
        &self,
        node: &Node<PrivateIpc>,
    ) -> Result<Factory<E, H>, TransportError>
    where
        E: Debug + ZeroCopySend + 'static,
        H: Debug + ZeroCopySend,
    {
        let mut attributes = AttributeVerifier::new();
        for (key, value) in &self.agreement {
            let (key, value) = attribute(key, value)?;
            attributes = attributes
                .require(&key, &value)
                .map_err(middleware_error("defining the attribute", key))?;
        }
        let opened = self.builder(node)?.open_with_attributes(&attributes);
        opened.map_err(|cause| self.not_opened(node, cause))
    }

    fn builder<E, H>(&self, node: &Node<PrivateIpc>) -> Result<ChannelBuilder<E, H>, TransportError>
    where
        E: Debug + ZeroCopySend + 'static,
        H: Debug + ZeroCopySend,
    {
        let name = service_name(&self.name)?;
        Ok(node.service_builder(&name).publish_subscribe::<[E]>().user_header::<H>())
    }

    fn not_opened(&self, node: &Node<PrivateIpc>, cause: OpenError) -> TransportError {
        let name = self.name.clone();
        match cause {
            OpenError::IncompatibleAttributes => {
                TransportError::Incompatible { name, cause: self.differences(node) }
            }
            OpenError::IncompatibleTypes
            | OpenError::IncompatibleMessagingPattern
            | OpenError::IncompatibleOverflowBehavior
            | OpenError::DoesNotSupportRequestedMinBufferSize
            | OpenError::DoesNotSupportRequestedMinHistorySize
            | OpenError::DoesNotSupportRequestedMinSubscriberBorrowedSamples
            | OpenError::DoesNotSupportRequestedAmountOfPublishers
            | OpenError::DoesNotSupportRequestedAmountOfSubscribers
            | OpenError::DoesNotSupportRequestedAmountOfNodes
            | OpenError::VersionMismatch => {
                TransportError::Incompatible { name, cause: format!("{cause:?}") }
            }
            OpenError::ExceedsMaxNumberOfNodes | OpenError::IsMarkedForDestruction => {
                self.taken(cause)
            }
            cause => middleware_error("opening the service", name)(cause),
        }
    }

    /// Creates the error for a slot that another process occupies.
    pub(super) fn taken(&self, cause: impl Debug) -> TransportError {
        TransportError::Taken { name: self.name.clone(), cause: format!("{cause:?}") }
    }

    /// Lists the differing attributes, such as "run_id is 7 there and 8 here".
    fn differences(&self, node: &Node<PrivateIpc>) -> String {
        let pattern = MessagingPattern::PublishSubscribe;
        let details = service_name(&self.name)
            .ok()
            .and_then(|name| PrivateIpc::details(&name, node.config(), pattern).ok().flatten());
        let Some(details) = details else { return "attributes".to_owned() };
        let attributes = details.static_details.attributes();
        let there = |wanted: &str| {
            let found = attributes.iter().find(|attribute| attribute.key() == wanted);
            found.map_or_else(|| "nothing".to_owned(), |attribute| attribute.value().to_string())
        };
        let different = self.agreement.iter().filter(|(key, here)| there(key) != *here);
        let words =
            different.map(|(key, here)| format!("{key} is {} there and {here} here", there(key)));
        words.collect::<Vec<_>>().join(", ")
    }
}

fn attribute(key: &str, value: &str) -> Result<(AttributeKey, AttributeValue), TransportError> {
    let name = key.try_into().map_err(middleware_error("defining the attribute", key))?;
    Ok((name, value.try_into().map_err(middleware_error("defining the attribute", key))?))
}

/// Flag that is set when a port could not connect to a peer.
///
/// Usually the peer died while connecting, and nothing is lost. However, iceoryx2 tries to connect
/// only once per peer. If a live peer was too slow, only a new port can reach it.
#[derive(Debug, Clone, Default)]
pub(super) struct Disconnected(Arc<AtomicBool>);

impl Disconnected {
    /// Returns a handler for broken connections, which sets the flag and keeps the port in use for
    /// the other peers.
    pub(super) fn handler<Cause, Info>(
        &self,
    ) -> impl Fn(Cause, &Info) -> DegradationAction + Send + 'static {
        let flag = self.0.clone();
        move |_, _| {
            flag.store(true, Ordering::Relaxed);
            DegradationAction::Ignore
        }
    }

    /// Whether the flag is set.
    pub(super) fn is_set(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    /// Clears the flag, before the port is recreated.
    pub(super) fn clear(&self) {
        self.0.store(false, Ordering::Relaxed);
    }
}
