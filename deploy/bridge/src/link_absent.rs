//! The link of a build without Zenoh: it cannot be opened, so nothing else here can exist.

use std::borrow::Cow;
use std::convert::Infallible;
use std::path::Path;
use std::time::Duration;

use crate::{LinkMode, Urgency};

/// An open session.
#[derive(Debug)]
pub struct Link(Infallible);

/// Sends messages under one name.
#[derive(Debug)]
pub struct MessageSender(Infallible);

/// Receives messages under a name or pattern.
#[derive(Debug)]
pub struct MessageReceiver(Infallible);

/// A received message.
#[derive(Debug)]
pub struct Message(Infallible);

/// Receives requests under a name.
#[derive(Debug)]
pub struct Requests(Infallible);

/// A request that has not been answered yet.
#[derive(Debug)]
pub struct Request(Infallible);

/// Announces to the peers that this end is alive.
#[derive(Debug)]
pub struct Presence(Infallible);

impl Link {
    /// Fails.
    ///
    /// # Errors
    /// Always: [`crate::check_available`].
    pub fn open(
        _mode: LinkMode<'_>,
        _token: &str,
        _zenoh_file: Option<&Path>,
    ) -> anyhow::Result<Self> {
        Err(crate::check_available().err().unwrap_or_else(|| anyhow::anyhow!("no link")))
    }

    /// Never called.
    #[must_use]
    pub fn refused(&self) -> u64 {
        match self.0 {}
    }

    /// Never called.
    #[must_use]
    pub fn is_authenticated(&self) -> bool {
        match self.0 {}
    }

    /// Never called.
    ///
    /// # Errors
    /// Never.
    pub fn sender(&self, _name: String, _urgency: Urgency) -> anyhow::Result<MessageSender> {
        match self.0 {}
    }

    /// Never called.
    ///
    /// # Errors
    /// Never.
    pub fn receiver(&self, _name: &str) -> anyhow::Result<MessageReceiver> {
        match self.0 {}
    }

    /// Never called.
    ///
    /// # Errors
    /// Never.
    pub fn requests(&self, _name: &str) -> anyhow::Result<Requests> {
        match self.0 {}
    }

    /// Never called.
    ///
    /// # Errors
    /// Never.
    pub fn request<T>(
        &self,
        _name: &str,
        _payload: Vec<u8>,
        _limit: Duration,
        _accept: impl FnMut(&[u8]) -> Option<T>,
    ) -> anyhow::Result<Option<T>> {
        match self.0 {}
    }

    /// Never called.
    ///
    /// # Errors
    /// Never.
    pub fn announce(&self, _name: String) -> anyhow::Result<Presence> {
        match self.0 {}
    }

    /// Never called.
    ///
    /// # Errors
    /// Never.
    pub fn presences(&self, _name: &str) -> anyhow::Result<MessageReceiver> {
        match self.0 {}
    }
}

impl MessageSender {
    /// Never called.
    ///
    /// # Errors
    /// Never.
    pub fn send(&self, _message: Vec<u8>) -> anyhow::Result<()> {
        match self.0 {}
    }
}

impl MessageReceiver {
    /// Never called.
    ///
    /// # Errors
    /// Never.
    pub fn next(&self) -> anyhow::Result<Option<Message>> {
        match self.0 {}
    }
}

impl Message {
    /// Never called.
    #[must_use]
    pub fn last_name(&self) -> &str {
        match self.0 {}
    }

    /// Never called.
    #[must_use]
    pub fn bytes(&self) -> Cow<'_, [u8]> {
        match self.0 {}
    }

    /// Never called.
    #[must_use]
    pub fn is_arrival(&self) -> bool {
        match self.0 {}
    }
}

impl Requests {
    /// Never called.
    ///
    /// # Errors
    /// Never.
    pub fn next(&self) -> anyhow::Result<Option<Request>> {
        match self.0 {}
    }

    /// Never called.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        match self.0 {}
    }
}

impl Request {
    /// Never called.
    #[must_use]
    pub fn bytes(&self) -> Vec<u8> {
        match self.0 {}
    }

    /// Never called.
    ///
    /// # Errors
    /// Never.
    pub fn answer(&self, _answer: Vec<u8>) -> anyhow::Result<()> {
        match self.0 {}
    }
}
