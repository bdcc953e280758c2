//! Sends policies to one host, on its own thread, so that a host with a full link delays no other.
//!
//! Only one policy is in flight at a time, and the next one is the newest at that moment. Otherwise
//! a long link would be full of policies that are outdated on arrival.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::Context;

use super::seal::SealedSender;

/// Time after which an unconfirmed policy counts as lost with its link, and is sent again.
const CONFIRMED_WITHIN: Duration = Duration::from_secs(2);

#[derive(Debug, Default)]
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    newest: Option<(u64, Arc<Vec<u8>>)>,
    /// The version that the host has confirmed.
    confirmed: u64,
    sent: Option<(u64, Instant)>,
    closed: bool,
}

/// Sends a host the newest policy. The thread stops when this is dropped.
#[derive(Debug)]
pub struct PolicySender(Arc<Shared>);

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        // The state is consistent after every statement, so a poisoned lock is harmless.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl PolicySender {
    /// Starts the thread.
    ///
    /// # Errors
    /// The system cannot start a thread.
    pub fn start(mut sender: SealedSender) -> anyhow::Result<Self> {
        let shared = Arc::new(Shared::default());
        let of_thread = Arc::clone(&shared);
        let thread = thread::Builder::new().name("policies".into());
        thread
            .spawn(move || send_policies(&of_thread, &mut sender))
            .context("cannot start a thread")?;
        Ok(Self(shared))
    }

    /// Replaces the policy to send by a newer one.
    pub fn offer(&self, version: u64, message: &Arc<Vec<u8>>) {
        self.0.lock().newest = Some((version, Arc::clone(message)));
        self.0.changed.notify_one();
    }

    /// Records that the host has this version.
    pub fn confirm(&self, version: u64) {
        self.0.lock().confirmed = version;
        self.0.changed.notify_one();
    }
}

impl Drop for PolicySender {
    fn drop(&mut self) {
        self.0.lock().closed = true;
        self.0.changed.notify_one();
    }
}

fn send_policies(shared: &Shared, sender: &mut SealedSender) {
    let mut state = shared.lock();
    while !state.closed {
        match state.due(Instant::now()) {
            Some((version, message)) => {
                drop(state);
                // Sending fails only if the session is closed, which ends the gateway and this
                // thread.
                let _ = sender.send(message.as_ref().clone());
                state = shared.lock();
                state.sent = Some((version, Instant::now()));
            }
            None => {
                let waited = shared.changed.wait_timeout(state, CONFIRMED_WITHIN);
                state = waited.unwrap_or_else(PoisonError::into_inner).0;
            }
        }
    }
}

impl State {
    /// Returns the policy to send now, if any.
    fn due(&self, now: Instant) -> Option<(u64, Arc<Vec<u8>>)> {
        let (version, message) = self.newest.as_ref()?;
        let is_in_flight = self.sent.is_some_and(|(sent, at)| {
            sent > self.confirmed && now.duration_since(at) < CONFIRMED_WITHIN
        });
        let wanted = *version > self.confirmed && !is_in_flight;
        wanted.then(|| (*version, Arc::clone(message)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_policy_is_in_flight_at_a_time_and_a_lost_one_is_sent_again() {
        let now = Instant::now();
        let mut state = State::default();
        assert!(state.due(now).is_none());
        state.newest = Some((3, Arc::default()));
        assert_eq!(state.due(now).unwrap().0, 3);
        state.sent = Some((3, now));
        state.newest = Some((5, Arc::default()));
        assert!(state.due(now).is_none());
        assert_eq!(state.due(now + CONFIRMED_WITHIN).unwrap().0, 5);
        state.confirmed = 3;
        assert_eq!(state.due(now).unwrap().0, 5);
        state.confirmed = 5;
        assert!(state.due(now).is_none());
    }
}
