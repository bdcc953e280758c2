//! Which host has which of the run's places.

use std::time::{Duration, Instant};

use dmprl_shared::transport::delivery::Mark;

use super::wire::{Held, HostRequest, HostStatus};
use crate::control::HostNow;

/// A host that is silent keeps its places so long where somebody else asks for them: longer than a
/// link is down, a switch restarted or a machine rebooted.
const KEPT: Duration = Duration::from_secs(600);
/// One that was taken in and has never told anything of itself did not come to be.
const BEGUN_WITHIN: Duration = Duration::from_secs(60);
/// Who asks for places is told of hosts that have been silent for so long; the others tell of
/// themselves a few times a second.
const SILENT: Duration = Duration::from_secs(10);
/// Starts that each worker has in a session, of which the launcher makes incarnations.
const STARTS_BITS: u32 = 16;

/// A host that takes part, or did.
#[derive(Debug, Clone)]
pub struct Host {
    /// Part of its names since it last came.
    pub seat: u64,
    /// Which start of `dmprl bridge`.
    pub host: u64,
    /// What people call it.
    pub name: String,
    /// Its places.
    pub held: Held,
    /// How many.
    pub workers: u32,
    /// When it last said anything.
    pub heard: Instant,
    /// Whether its liveliness token is there.
    pub here: bool,
    /// What it last told of itself.
    pub status: Option<HostStatus>,
    /// It took part before this gateway began: what it did by then is counted already.
    pub counted_before: bool,
}

impl Host {
    /// What whoever watches the run is told of it.
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

    /// How long its places are kept for it yet.
    fn free_in(&self, now: Instant) -> Duration {
        let kept = if self.status.is_some() { KEPT } else { BEGUN_WITHIN };
        kept.saturating_sub(now.duration_since(self.heard))
    }
}

/// The newest session of which the learner has seen segments of these workers.
fn seen(first: u32, workers: u32, marks: &[Mark]) -> Option<u32> {
    let of = marks.iter().skip(first as usize).take(workers as usize);
    of.filter(|mark| mark.sequence > 0).map(|mark| mark.incarnation >> STARTS_BITS).max()
}

/// Why a host is not taken in.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refusal {
    /// Why, and what can be done.
    pub reason: String,
    /// Whether asking again may help.
    pub later: bool,
}

/// All hosts of a run.
#[derive(Debug)]
pub struct Seats {
    /// The first worker of other hosts, and how many there may be.
    first: u32,
    places: u32,
    /// The session that the next host gets: no two have the same, so that no start of a worker has
    /// the number of another.
    session: u32,
    /// The session that each place was last given in, as far as is known here.
    newest: Vec<u32>,
    hosts: Vec<Host>,
}

impl Seats {
    /// Nobody has come yet; `session`: the first that may be given.
    #[must_use]
    pub fn new(first: u32, places: u32, session: u32) -> Self {
        Self { first, places, session, newest: vec![0; places as usize], hosts: Vec::new() }
    }

    /// The first session that was not given yet.
    #[must_use]
    pub fn session(&self) -> u32 {
        self.session
    }

    /// Everybody.
    #[must_use]
    pub fn hosts(&self) -> &[Host] {
        &self.hosts
    }

    /// Who speaks by this seat.
    pub fn of_seat(&mut self, seat: u64) -> Option<&mut Host> {
        self.hosts.iter_mut().find(|host| host.seat == seat)
    }

    /// Forgets a host that has left.
    pub fn remove(&mut self, seat: u64) -> Option<Host> {
        let at = self.hosts.iter().position(|host| host.seat == seat)?;
        Some(self.hosts.remove(at))
    }

    /// Gives a host its places: those it had, else the first that are free. `marks`: what the
    /// learner knows of each worker of the run.
    ///
    /// # Errors
    /// There are none, or what it had is another's now.
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
                        "it took part with {} workers and asks now with {workers}: start it again",
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
                // It was started again, and what it was before is no more.
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

    /// Whether a host may go on in the places that it had: of older starts than it knows the
    /// learner takes nothing.
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
            format!("; {name} is out of reach and keeps its own for {minutes} min")
        });
        format!(
            "{taken} of {} places for workers of other hosts are taken (bridge.workers_max), it \
             brings {workers} and they must lie side by side; a host that leaves makes room{}",
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
        // A gateway that died has forgotten everybody.
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

    /// Its first start had once kept all places, though its relay never came to be.
    #[test]
    fn a_host_that_was_taken_in_and_never_began_makes_room_soon() {
        let now = Instant::now();
        let mut seats = Seats::new(0, 2, 0);
        let held = seats.admit(&request(1, 2, None), 11, (&[], now)).unwrap();
        assert!(seats.admit(&request(2, 2, None), 12, (&[], now)).unwrap_err().later);
        // The same host, started again, has them at once, and its workers count on.
        let again = seats.admit(&request(1, 2, None), 13, (&[], now)).unwrap();
        assert_eq!((again.first, again.session), (held.first, held.session + 1));
        let held = seats.admit(&request(2, 2, None), 12, (&[], now + BEGUN_WITHIN)).unwrap();
        assert_eq!((held.first, held.session), (0, again.session + 1));
    }

    /// Its workers' segments would be passed over as those of an older start, without a word.
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
        // Another gateway knows it by what the learner has seen.
        let marks = [Mark { incarnation: b.session << STARTS_BITS, sequence: 1 }];
        let mut next = Seats::new(0, 2, 0);
        assert!(next.admit(&request(1, 2, Some(a)), 15, (&marks, now)).is_err());
        assert_eq!(next.admit(&request(2, 2, Some(b)), 16, (&marks, now)).unwrap(), b);
    }
}
