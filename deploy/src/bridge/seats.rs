//! Which host has which of the run's places.

use std::time::{Duration, Instant};

use dmprl_shared::transport::delivery::Mark;

use super::wire::{Held, HostRequest, HostStatus};

/// A host that is silent keeps its places so long where somebody else asks for them: longer than a
/// link is down, a switch restarted or a machine rebooted.
const KEPT: Duration = Duration::from_secs(600);
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
    /// Which session of the run this is, from 0.
    session: u32,
    hosts: Vec<Host>,
}

impl Seats {
    /// Nobody has come yet.
    #[must_use]
    pub fn new(first: u32, places: u32, session: u32) -> Self {
        Self { first, places, session, hosts: Vec::new() }
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
        if let Some(known) = self.hosts.iter_mut().find(|known| known.host == host) {
            (known.seat, known.heard, known.here) = (seat, now, true);
            return Ok(known.held);
        }
        let held = match request.held {
            Some(held) if self.is_free(held.first, workers) => held,
            Some(_) => {
                let reason = "the places of its workers were given to another host while it was \
                              away: start it again";
                return Err(Refusal { reason: reason.to_owned(), later: false });
            }
            None => self.place(workers, marks, now)?,
        };
        let name = request.name.clone();
        let (heard, here, status) = (now, true, None);
        let counted_before = request.held.is_some();
        self.hosts.push(Host {
            seat,
            host,
            name,
            held,
            workers,
            heard,
            here,
            status,
            counted_before,
        });
        Ok(held)
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
                return Ok(Held { first, session: self.session_of(first, workers, marks) });
            }
            let forgotten = |host: &Host| !host.here && now.duration_since(host.heard) >= KEPT;
            match self.hosts.iter().position(forgotten) {
                Some(at) => drop(self.hosts.remove(at)),
                None => break,
            }
        }
        let taken: u32 = self.hosts.iter().map(|host| host.workers).sum();
        let reason = format!(
            "{taken} of {} places for workers of other hosts are taken (bridge.workers_max), it \
             brings {workers}; a host that leaves makes room",
            self.places
        );
        Err(Refusal { reason, later: true })
    }

    /// One after all whose segments the learner has seen of these workers: of an older start it
    /// would take none.
    fn session_of(&self, first: u32, workers: u32, marks: &[Mark]) -> u32 {
        let of = marks.iter().skip(first as usize).take(workers as usize);
        let seen = of.filter(|mark| mark.sequence > 0).map(|mark| mark.incarnation >> STARTS_BITS);
        seen.max().map_or(self.session, |last| self.session.max(last + 1))
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
        assert_eq!(admit(1, 4, None).unwrap(), a, "the same start of the program");
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
        assert_eq!(admit(6, 4, None).unwrap(), a);
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
        seats.of_seat(11).unwrap().here = false;
        let marks = [Mark { incarnation: 5 << STARTS_BITS, sequence: 7 }, Mark::default()];
        let soon = now + KEPT / 2;
        assert!(seats.admit(&request(2, 2, None), 12, (&marks, soon)).unwrap_err().later);
        let late = now + KEPT;
        let held = seats.admit(&request(2, 2, None), 12, (&marks, late)).unwrap();
        assert_eq!(held, Held { first: 0, session: 6 });
        assert!(seats.of_seat(11).is_none());
    }
}
