//! Assigns the run's places to hosts.

use std::time::{Duration, Instant};

use dmprl_shared::transport::delivery::Mark;

use super::wire::{Held, HostRequest, HostStatus};
use crate::control::HostNow;

/// Time for which a silent host keeps its places although another host needs them. It is longer
/// than a broken link, the restart of a switch or the reboot of a machine takes.
const KEPT: Duration = Duration::from_secs(600);
/// Time limit for an admitted host to send its first status.
const BEGUN_WITHIN: Duration = Duration::from_secs(60);
/// Silence after which a host is reported as unreachable to a host that needs places. Others send a
/// status several times per second.
const SILENT: Duration = Duration::from_secs(10);
/// Bits of an incarnation that count a worker's starts within a session.
const STARTS_BITS: u32 = 16;

/// A host that takes part or has taken part.
#[derive(Debug, Clone)]
pub struct Host {
    /// Current seat: part of the names of its messages, renewed with each admission.
    pub seat: u64,
    /// Number that identifies the start of `dmprl bridge`.
    pub host: u64,
    /// Name of the host, for display.
    pub name: String,
    /// Places of the host.
    pub held: Held,
    /// Number of its workers.
    pub workers: u32,
    /// Time of its last message.
    pub heard: Instant,
    /// True while its liveliness token exists.
    pub here: bool,
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
            here: self.here,
            workers: status.map_or(0, |status| status.workers.count),
            kept: status.map_or(0, |status| status.workers.queued_segments),
            acked: status.map_or(0, |status| status.sent.acked),
            restarts: status.map_or(0, |status| status.workers.restarts),
        }
    }

    /// Time after which its places may be given to another host.
    fn free_in(&self, now: Instant) -> Duration {
        let kept = if self.status.is_some() { KEPT } else { BEGUN_WITHIN };
        kept.saturating_sub(now.duration_since(self.heard))
    }
}

/// The newest session of these workers from which the learner has seen segments.
fn seen(first: u32, workers: u32, marks: &[Mark]) -> Option<u32> {
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

/// The hosts of a run.
#[derive(Debug)]
pub struct Seats {
    /// First worker of other hosts, and the number of their places.
    first: u32,
    places: u32,
    /// Session of the next host. Each host gets a different one, so that all incarnations are
    /// distinct.
    session: u32,
    /// The last known session of each place.
    newest: Vec<u32>,
    hosts: Vec<Host>,
}

impl Seats {
    /// Creates the list without hosts; `session` is the first unused session.
    #[must_use]
    pub fn new(first: u32, places: u32, session: u32) -> Self {
        Self { first, places, session, newest: vec![0; places as usize], hosts: Vec::new() }
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

    /// The host with this seat.
    pub fn of_seat(&mut self, seat: u64) -> Option<&mut Host> {
        self.hosts.iter_mut().find(|host| host.seat == seat)
    }

    /// Removes a host that has left.
    pub fn remove(&mut self, seat: u64) -> Option<Host> {
        let at = self.hosts.iter().position(|host| host.seat == seat)?;
        Some(self.hosts.remove(at))
    }

    /// Assigns places to a host: its previous ones, or else the first free ones. `marks` is the
    /// learner's last acknowledgement for each worker of the run.
    ///
    /// # Errors
    /// No places are free, or its previous places belong to another host now.
    pub fn admit(
        &mut self,
        request: &HostRequest,
        seat: u64,
        (marks, now): (&[Mark], Instant),
    ) -> Result<Held, Refusal> {
        let HostRequest { host, workers, .. } = *request;
        let known = self.hosts.iter().position(|known| known.host == host);
        let held = match (known, request.held) {
            (Some(at), Some(_)) => {
                let known = &mut self.hosts[at];
                if known.workers != workers {
                    let reason = format!(
                        "it joined with {} workers and now asks for {workers}: start it again",
                        known.workers
                    );
                    return Err(Refusal { reason, later: false });
                }
                (known.seat, known.heard, known.here) = (seat, now, true);
                return Ok(known.held);
            }
            (None, Some(held)) if self.is_still(held, workers, marks) => held,
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
        self.session = self.session.max(held.session.saturating_add(1));
        self.newest_of(held.first, workers).fill(held.session);
        self.hosts.push(Host {
            seat,
            host,
            name: request.name.clone(),
            held,
            workers,
            heard: now,
            here: true,
            status: None,
            counted_before: request.held.is_some(),
        });
        Ok(held)
    }

    /// Returns true if a host may continue in its previous places. The learner drops segments of
    /// incarnations older than those it knows.
    fn is_still(&mut self, held: Held, workers: u32, marks: &[Mark]) -> bool {
        self.is_free(held.first, workers)
            && seen(held.first, workers, marks).is_none_or(|seen| seen <= held.session)
            && self.newest_of(held.first, workers).iter().all(|newest| *newest <= held.session)
    }

    fn newest_of(&mut self, first: u32, workers: u32) -> &mut [u32] {
        let at = (first - self.first) as usize;
        &mut self.newest[at..at + workers as usize]
    }

    fn place(&mut self, workers: u32, marks: &[Mark], now: Instant) -> Result<Held, Refusal> {
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
                let after = seen(first, workers, marks).map_or(0, |seen| seen.saturating_add(1));
                return Ok(Held { first, session: self.session.max(after) });
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
        let silent = self.hosts.iter().filter(|host| now.duration_since(host.heard) >= SILENT);
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
                host.held.first + host.workers <= first || first + workers <= host.held.first
            })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::Greeting;

    fn request(host: u64, workers: u32, held: Option<Held>) -> HostRequest {
        let (speaks, token, name) = (Greeting::this(), String::new(), format!("host{host}"));
        HostRequest { speaks, token, host, name, workers, held }
    }

    #[test]
    fn a_host_that_comes_back_has_its_places_and_two_never_share_one() {
        let now = Instant::now();
        let mut seats = Seats::new(3, 8, 0);
        let mut admit = |host, workers, held| {
            seats.admit(&request(host, workers, held), host + 100, (&[], now))
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
        let mut next = Seats::new(3, 8, 0);
        let mut admit =
            |host, workers, held| next.admit(&request(host, workers, held), host, (&[], now));
        assert_eq!(admit(2, 3, Some(b)).unwrap(), b);
        let other = admit(6, 4, None).unwrap();
        assert_eq!(other.first, a.first);
        assert!(other.session > b.session, "no two have the same");
        let gone = admit(1, 4, Some(a)).unwrap_err();
        assert!(!gone.later && gone.reason.contains("another host"), "{}", gone.reason);
        assert!(admit(7, 4, Some(Held { first: u32::MAX, session: 0 })).is_err());
    }

    #[test]
    fn a_silent_host_makes_room_when_somebody_needs_it_and_its_successor_counts_on() {
        let now = Instant::now();
        let mut seats = Seats::new(0, 2, 1);
        let held = seats.admit(&request(1, 2, None), 11, (&[], now)).unwrap();
        assert_eq!(held, Held { first: 0, session: 1 });
        seats.of_seat(11).unwrap().status = Some(HostStatus::default());
        let marks = [Mark { incarnation: 5 << STARTS_BITS, sequence: 7 }, Mark::default()];
        let soon = now + KEPT / 2;
        let refusal = seats.admit(&request(2, 2, None), 12, (&marks, soon)).unwrap_err();
        assert!(refusal.later && refusal.reason.contains("host1 is out of reach"), "{refusal:?}");
        let late = now + KEPT;
        let held = seats.admit(&request(2, 2, None), 12, (&marks, late)).unwrap();
        assert_eq!(held, Held { first: 0, session: 6 });
        assert!(seats.of_seat(11).is_none());
    }

    /// Regression test: a start whose relay never ran once kept all places.
    #[test]
    fn a_host_that_was_taken_in_and_never_began_makes_room_soon() {
        let now = Instant::now();
        let mut seats = Seats::new(0, 2, 0);
        let held = seats.admit(&request(1, 2, None), 11, (&[], now)).unwrap();
        assert!(seats.admit(&request(2, 2, None), 12, (&[], now)).unwrap_err().later);
        // The same host, restarted, gets them at once, and its workers' incarnations continue.
        let again = seats.admit(&request(1, 2, None), 13, (&[], now)).unwrap();
        assert_eq!((again.first, again.session), (held.first, held.session + 1));
        let held = seats.admit(&request(2, 2, None), 12, (&[], now + BEGUN_WITHIN)).unwrap();
        assert_eq!((held.first, held.session), (0, again.session + 1));
    }

    /// The learner would silently skip its workers' segments as those of an older incarnation.
    #[test]
    fn a_host_does_not_go_on_in_places_that_another_has_used_since() {
        let now = Instant::now();
        let mut seats = Seats::new(0, 2, 0);
        let a = seats.admit(&request(1, 2, None), 11, (&[], now)).unwrap();
        seats.remove(11);
        let b = seats.admit(&request(2, 2, None), 12, (&[], now)).unwrap();
        assert!(b.session > a.session, "nothing of the first need be acknowledged for it");
        seats.remove(12);
        let refusal = seats.admit(&request(1, 2, Some(a)), 14, (&[], now)).unwrap_err();
        assert!(refusal.reason.contains("start it again"), "{}", refusal.reason);
        // A new gateway recognises it by the learner's marks.
        let marks = [Mark { incarnation: b.session << STARTS_BITS, sequence: 1 }];
        let mut next = Seats::new(0, 2, 0);
        assert!(next.admit(&request(1, 2, Some(a)), 15, (&marks, now)).is_err());
        assert_eq!(next.admit(&request(2, 2, Some(b)), 16, (&marks, now)).unwrap(), b);
    }
}
