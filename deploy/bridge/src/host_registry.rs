//! Leases the run's places for workers to hosts.

use std::time::{Duration, Instant};

use dmprl_control::HostNow;
use dmprl_shared::transport::delivery::Watermark;

use super::host_messages::{HostRequest, HostStatus, Lease};

/// Time for which a silent host keeps its places although another host needs them. It is longer
/// than a broken link, the restart of a switch or the reboot of a machine takes.
const LEASE_TIME: Duration = Duration::from_secs(600);
/// Time limit for an admitted host to send its first status.
const FIRST_STATUS_LIMIT: Duration = Duration::from_secs(60);
/// Silence after which a host is reported as unreachable to a host that needs places. Others send a
/// status several times per second.
const UNREACHABLE_AFTER: Duration = Duration::from_secs(10);
/// Bits of an incarnation that count a worker's starts within a session.
const STARTS_BITS: u32 = 16;

/// A host that takes part in the run, or did so recently.
#[derive(Debug, Clone)]
pub struct Host {
    /// Part of the names of its messages, renewed with each admission.
    pub channel: u64,
    /// Number that identifies the start of `dmprl bridge`.
    pub host: u64,
    /// Name of the host, for display.
    pub name: String,
    /// Places of its workers.
    pub lease: Lease,
    /// Number of its workers.
    pub workers: u32,
    /// Time of its last message.
    pub last_heard: Instant,
    /// True while its liveliness token exists.
    pub is_present: bool,
    /// Last status that it sent.
    pub status: Option<HostStatus>,
    /// True if it joined before this gateway started, so that its earlier counts are already
    /// included.
    pub counted_before: bool,
}

impl Host {
    /// The host's state, for display.
    #[must_use]
    pub fn shown(&self) -> HostNow {
        let status = self.status.as_ref();
        HostNow {
            name: self.name.clone(),
            here: self.is_present,
            workers: status.map_or(0, |status| status.workers.count),
            kept: status.map_or(0, |status| status.workers.queued_segments),
            acked: status.map_or(0, |status| status.sent.acked),
            restarts: status.map_or(0, |status| status.workers.restarts),
        }
    }

    /// Time after which its places may be given to another host.
    fn free_in(&self, now: Instant) -> Duration {
        let lease_time = if self.status.is_some() { LEASE_TIME } else { FIRST_STATUS_LIMIT };
        lease_time.saturating_sub(now.duration_since(self.last_heard))
    }
}

/// The newest session of these workers from which the learner has acknowledged segments.
fn newest_acknowledged(first: u32, workers: u32, marks: &[Watermark]) -> Option<u32> {
    let of = marks.iter().skip(first as usize).take(workers as usize);
    of.filter(|mark| mark.sequence > 0).map(|mark| mark.incarnation >> STARTS_BITS).max()
}

/// Rejection of a host.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refusal {
    /// The reason and a remedy.
    pub reason: String,
    /// True if a later request may succeed.
    pub later: bool,
}

/// The hosts of a run and their leases.
#[derive(Debug)]
pub struct HostRegistry {
    /// First worker of other hosts, and the number of their places.
    first: u32,
    places: u32,
    /// Session of the next host. Each host gets a different one, so that all incarnations are
    /// distinct.
    session: u32,
    /// The last known session of each place.
    last_sessions: Vec<u32>,
    hosts: Vec<Host>,
}

impl HostRegistry {
    /// Creates a registry without hosts; `session` is the first unused session.
    #[must_use]
    pub fn new(first: u32, places: u32, session: u32) -> Self {
        Self { first, places, session, last_sessions: vec![0; places as usize], hosts: Vec::new() }
    }

    /// The first unused session.
    #[must_use]
    pub fn session(&self) -> u32 {
        self.session
    }

    /// All hosts.
    #[must_use]
    pub fn hosts(&self) -> &[Host] {
        &self.hosts
    }

    /// The host with this channel.
    pub fn by_channel(&mut self, channel: u64) -> Option<&mut Host> {
        self.hosts.iter_mut().find(|host| host.channel == channel)
    }

    /// Removes a host that has left.
    pub fn remove(&mut self, channel: u64) -> Option<Host> {
        let at = self.hosts.iter().position(|host| host.channel == channel)?;
        Some(self.hosts.remove(at))
    }

    /// Leases places to a host: its previous ones, or else the first free ones. `marks` is the
    /// learner's last acknowledgement for each worker of the run.
    ///
    /// # Errors
    /// No places are free, or its previous places belong to another host now.
    pub fn admit(
        &mut self,
        request: &HostRequest,
        channel: u64,
        marks: &[Watermark],
        now: Instant,
    ) -> Result<Lease, Refusal> {
        let HostRequest { host, workers, .. } = *request;
        let known = self.hosts.iter().position(|known| known.host == host);
        let lease = match (known, request.lease) {
            (Some(at), Some(_)) => {
                let known = &mut self.hosts[at];
                if known.workers != workers {
                    let reason = format!(
                        "it joined with {} workers and now asks for {workers}: start it again",
                        known.workers
                    );
                    return Err(Refusal { reason, later: false });
                }
                (known.channel, known.last_heard, known.is_present) = (channel, now, true);
                return Ok(known.lease);
            }
            (None, Some(lease)) if self.is_valid(lease, workers, marks) => lease,
            (None, Some(_)) => {
                let reason = "the places of its workers were given to another host while it was \
                              away: start it again";
                return Err(Refusal { reason: reason.to_owned(), later: false });
            }
            (known, None) => {
                // It was restarted, so its previous start no longer exists.
                known.map(|at| self.hosts.remove(at));
                self.place(workers, marks, now)?
            }
        };
        self.session = self.session.max(lease.session.saturating_add(1));
        self.sessions_of(lease.first, workers).fill(lease.session);
        self.hosts.push(Host {
            channel,
            host,
            name: request.name.clone(),
            lease,
            workers,
            last_heard: now,
            is_present: true,
            status: None,
            counted_before: request.lease.is_some(),
        });
        Ok(lease)
    }

    /// Returns true if a host may continue in its previous places. The learner drops segments of
    /// incarnations older than those it knows.
    fn is_valid(&mut self, lease: Lease, workers: u32, marks: &[Watermark]) -> bool {
        self.is_free(lease.first, workers)
            && newest_acknowledged(lease.first, workers, marks)
                .is_none_or(|newest| newest <= lease.session)
            && self.sessions_of(lease.first, workers).iter().all(|last| *last <= lease.session)
    }

    fn sessions_of(&mut self, first: u32, workers: u32) -> &mut [u32] {
        let at = (first - self.first) as usize;
        &mut self.last_sessions[at..at + workers as usize]
    }

    fn place(&mut self, workers: u32, marks: &[Watermark], now: Instant) -> Result<Lease, Refusal> {
        if workers > self.places {
            let reason = format!(
                "it brings {workers} workers, the run has places for {} of other hosts \
                 (bridge.workers_max)",
                self.places
            );
            return Err(Refusal { reason, later: false });
        }
        loop {
            if let Some(first) = self.free(workers) {
                let after = newest_acknowledged(first, workers, marks)
                    .map_or(0, |newest| newest.saturating_add(1));
                return Ok(Lease { first, session: self.session.max(after) });
            }
            match self.hosts.iter().position(|host| host.free_in(now).is_zero()) {
                Some(at) => drop(self.hosts.remove(at)),
                None => break,
            }
        }
        Err(Refusal { reason: self.full(workers, now), later: true })
    }

    fn full(&self, workers: u32, now: Instant) -> String {
        let taken: u32 = self.hosts.iter().map(|host| host.workers).sum();
        let silent = self
            .hosts
            .iter()
            .filter(|host| now.duration_since(host.last_heard) >= UNREACHABLE_AFTER);
        let silent = silent.map(|host| {
            let (name, minutes) = (host.name.escape_debug(), host.free_in(now).as_secs() / 60 + 1);
            format!("; {name} is out of reach and keeps its places for another {minutes} min")
        });
        format!(
            "{taken} of {} places for workers of other hosts are taken (bridge.workers_max), \
             and this host needs {workers} adjacent ones; wait until a host leaves{}",
            self.places,
            silent.collect::<String>()
        )
    }

    fn free(&self, workers: u32) -> Option<u32> {
        (self.first..self.first + self.places).find(|&first| self.is_free(first, workers))
    }

    fn is_free(&self, first: u32, workers: u32) -> bool {
        let end = self.first + self.places;
        let inside = first >= self.first && first.checked_add(workers).is_some_and(|to| to <= end);
        inside
            && self.hosts.iter().all(|host| {
                host.lease.first + host.workers <= first || first + workers <= host.lease.first
            })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn request(host: u64, workers: u32, lease: Option<Lease>) -> HostRequest {
        HostRequest { host, name: format!("host{host}"), workers, sealed: true, lease }
    }

    #[test]
    fn a_returning_host_gets_its_places_and_no_two_hosts_share_one() {
        let now = Instant::now();
        let mut registry = HostRegistry::new(3, 8, 0);
        let mut admit = |host, workers, lease| {
            registry.admit(&request(host, workers, lease), host + 100, &[], now)
        };
        let (a, b) = (admit(1, 4, None).unwrap(), admit(2, 3, None).unwrap());
        assert_eq!((a.first, b.first), (3, 7));
        assert_eq!(admit(1, 4, Some(a)).unwrap(), a, "the same start of the program");
        let other = admit(1, 3, Some(a)).unwrap_err();
        assert!(!other.later && other.reason.contains("with 4 workers"), "{}", other.reason);
        let full = admit(3, 2, None).unwrap_err();
        assert!(full.later && full.reason.contains("7 of 8 places"), "{}", full.reason);
        let never = admit(4, 9, None).unwrap_err();
        assert!(!never.later && never.reason.contains("bridge.workers_max"));
        assert_eq!(admit(5, 1, None).unwrap().first, 10);
        // The successor of a dead gateway does not know any host.
        let mut next = HostRegistry::new(3, 8, 0);
        let mut admit =
            |host, workers, lease| next.admit(&request(host, workers, lease), host, &[], now);
        assert_eq!(admit(2, 3, Some(b)).unwrap(), b);
        let other = admit(6, 4, None).unwrap();
        assert_eq!(other.first, a.first);
        assert!(other.session > b.session, "no two have the same");
        let gone = admit(1, 4, Some(a)).unwrap_err();
        assert!(!gone.later && gone.reason.contains("another host"), "{}", gone.reason);
        assert!(admit(7, 4, Some(Lease { first: u32::MAX, session: 0 })).is_err());
    }

    #[test]
    fn places_of_a_silent_host_go_to_another_with_a_later_session() {
        let now = Instant::now();
        let mut registry = HostRegistry::new(0, 2, 1);
        let lease = registry.admit(&request(1, 2, None), 11, &[], now).unwrap();
        assert_eq!(lease, Lease { first: 0, session: 1 });
        registry.by_channel(11).unwrap().status = Some(HostStatus::default());
        let marks =
            [Watermark { incarnation: 5 << STARTS_BITS, sequence: 7 }, Watermark::default()];
        let soon = now + LEASE_TIME / 2;
        let refusal = registry.admit(&request(2, 2, None), 12, &marks, soon).unwrap_err();
        assert!(refusal.later && refusal.reason.contains("host1 is out of reach"), "{refusal:?}");
        let late = now + LEASE_TIME;
        let lease = registry.admit(&request(2, 2, None), 12, &marks, late).unwrap();
        assert_eq!(lease, Lease { first: 0, session: 6 });
        assert!(registry.by_channel(11).is_none());
    }

    /// Regression test: a start whose relay never ran once kept all places.
    #[test]
    fn a_host_that_never_sends_a_status_loses_its_places_soon() {
        let now = Instant::now();
        let mut registry = HostRegistry::new(0, 2, 0);
        let lease = registry.admit(&request(1, 2, None), 11, &[], now).unwrap();
        assert!(registry.admit(&request(2, 2, None), 12, &[], now).unwrap_err().later);
        // The same host, restarted, gets them at once, and its workers' incarnations continue.
        let again = registry.admit(&request(1, 2, None), 13, &[], now).unwrap();
        assert_eq!((again.first, again.session), (lease.first, lease.session + 1));
        let lease =
            registry.admit(&request(2, 2, None), 12, &[], now + FIRST_STATUS_LIMIT).unwrap();
        assert_eq!((lease.first, lease.session), (0, again.session + 1));
    }

    /// The learner would silently skip its workers' segments as those of an older incarnation.
    #[test]
    fn a_host_does_not_return_to_places_that_another_has_used_since() {
        let now = Instant::now();
        let mut registry = HostRegistry::new(0, 2, 0);
        let a = registry.admit(&request(1, 2, None), 11, &[], now).unwrap();
        registry.remove(11);
        let b = registry.admit(&request(2, 2, None), 12, &[], now).unwrap();
        assert!(b.session > a.session, "nothing of the first need be acknowledged for it");
        registry.remove(12);
        let refusal = registry.admit(&request(1, 2, Some(a)), 14, &[], now).unwrap_err();
        assert!(refusal.reason.contains("start it again"), "{}", refusal.reason);
        // A new gateway recognises it by the learner's marks.
        let marks = [Watermark { incarnation: b.session << STARTS_BITS, sequence: 1 }];
        let mut next = HostRegistry::new(0, 2, 0);
        assert!(next.admit(&request(1, 2, Some(a)), 15, &marks, now).is_err());
        assert_eq!(next.admit(&request(2, 2, Some(b)), 16, &marks, now).unwrap(), b);
    }
}
