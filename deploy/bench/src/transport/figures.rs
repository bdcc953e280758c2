//! The report of `dmprl bench transport`: one JSON object for programs, a table for people.

use dmprl_run::Machine;
use dmprl_run::format::grouped;
use dmprl_shared::config::DeliveryLevel;
use serde_json::{Map, Value, json};

use super::TransportBench;
use super::python;
use super::streams::StreamKind;
use crate::drain_receiver::Discrepancies;
use crate::statistics::{load_average, max, median, min};
use crate::synthetic_segments::{QUEUE_SEGMENTS, SIZES};

/// Name of the shared-memory transport in the report.
pub(super) const SHARED_MEMORY: &str = "shared_memory";

/// Segments per second of each transport, by size and round, with further figures.
#[derive(Debug, Clone)]
pub struct Figures {
    workers: u32,
    level: DeliveryLevel,
    seconds: f64,
    machine: Machine,
    load_average: Option<f64>,
    /// (bytes, name, rounds) of each available transport.
    rounds: Vec<(usize, &'static str, Vec<f64>)>,
    /// (bytes, fraction of a core that the receiver used in a round).
    sink_shares: Vec<(usize, f64)>,
    /// (name, description or reason why it is unavailable), each name once.
    notes: Vec<(&'static str, String)>,
    /// (bytes, rejected and lost segments).
    pub(super) discrepancies: Vec<(usize, Discrepancies)>,
    /// Fraction of a core that a worker uses while its queue and outbox are full.
    pub(super) blocked_cpu_fraction: Option<f64>,
}

impl Figures {
    pub(super) fn new(bench: &TransportBench, machine: Machine) -> Self {
        Self {
            workers: bench.workers,
            level: bench.level,
            seconds: bench.duration.as_secs_f64(),
            machine,
            load_average: load_average(),
            rounds: Vec::new(),
            sink_shares: Vec::new(),
            notes: Vec::new(),
            discrepancies: Vec::new(),
            blocked_cpu_fraction: None,
        }
    }

    /// Adds a round of `name`.
    pub(super) fn add(&mut self, bytes: usize, name: &'static str, segments_per_s: f64) {
        let known = |entry: &&mut (usize, &str, Vec<f64>)| (entry.0, entry.1) == (bytes, name);
        match self.rounds.iter_mut().find(known) {
            Some((_, _, rounds)) => rounds.push(segments_per_s),
            None => self.rounds.push((bytes, name, vec![segments_per_s])),
        }
    }

    /// Adds the receiver's processor time of a round.
    pub(super) fn add_sink_share(&mut self, bytes: usize, share: f64) {
        self.sink_shares.push((bytes, share));
    }

    /// Adds a description of `name`, or the reason why it is unavailable, unless it has a note.
    pub(super) fn note(&mut self, name: &'static str, text: &str) {
        if self.notes.iter().all(|(noted, _)| *noted != name) {
            self.notes.push((name, text.to_owned()));
        }
    }

    fn rates(&self, bytes: usize, name: &str) -> &[f64] {
        let mut rounds = self.rounds.iter();
        let found = rounds.find(|entry| (entry.0, entry.1) == (bytes, name));
        found.map_or(&[], |(_, _, rates)| rates)
    }

    fn segments_per_s(&self, bytes: usize, name: &str) -> Option<f64> {
        median(self.rates(bytes, name))
    }

    /// The rate of shared memory divided by that of `name`: the median of the ratios in each round,
    /// because the machine's speed drifts less within a round than between rounds.
    fn ratio(&self, bytes: usize, name: &str) -> Option<f64> {
        let pairs = self.rates(bytes, SHARED_MEMORY).iter().zip(self.rates(bytes, name));
        median(&pairs.map(|(ours, other)| ours / other).collect::<Vec<_>>())
    }

    fn discrepancies(&self, bytes: usize) -> Discrepancies {
        let found = self.discrepancies.iter().find(|(of, _)| *of == bytes);
        found.map(|(_, discrepancies)| *discrepancies).unwrap_or_default()
    }

    /// Returns the figures as one JSON object. Unavailable ones are null.
    #[must_use]
    pub fn json(&self) -> Value {
        let notes: Map<_, _> =
            self.notes.iter().map(|(name, text)| ((*name).to_owned(), json!(text))).collect();
        json!({
            "sizes": SIZES.map(|size| self.size_json(size.bytes)),
            "blocked_cpu_fraction": self.blocked_cpu_fraction,
            // Those of the first size. Each size also has its own `peers`.
            "peers": self.each_peer(|name| self.segments_per_s(SIZES[0].bytes, name)),
            "workers": self.workers,
            "level": self.level,
            "queue_segments": QUEUE_SEGMENTS,
            "seconds": self.seconds,
            "notes": notes,
            "cpu": self.machine.cpu,
            "cores": self.machine.cores,
            "load_average": self.load_average,
        })
    }

    fn size_json(&self, bytes: usize) -> Value {
        let Discrepancies { rejected, duplicate, lost, received } = self.discrepancies(bytes);
        let rates = self.rates(bytes, SHARED_MEMORY);
        let shares = self.sink_shares.iter().filter(|(of, _)| *of == bytes);
        json!({
            "segment_bytes": bytes,
            "segments_per_s": median(rates),
            "mb_per_s": median(rates).map(|rate| rate * bytes as f64 / 1e6),
            "lost": lost,
            "duplicate": duplicate,
            "rejected": rejected,
            "received": received,
            "rounds": rates,
            "spread": { "min": min(rates), "max": max(rates) },
            "sink_cpu_share": median(&shares.map(|(_, share)| *share).collect::<Vec<_>>()),
            "peers": self.each_peer(|name| self.segments_per_s(bytes, name)),
            "to_peers": self.each_peer(|name| self.ratio(bytes, name)),
        })
    }

    fn each_peer(&self, of: impl Fn(&str) -> Option<f64>) -> Map<String, Value> {
        peers().map(|name| (name.to_owned(), of(name).into())).collect()
    }

    /// Returns the figures as a table.
    #[must_use]
    pub fn text(&self) -> String {
        let rounds = self.rates(SIZES[0].bytes, SHARED_MEMORY).len();
        let mut lines = vec![
            format!(
                "{} worker{} · level {} · queues of {QUEUE_SEGMENTS} segments · median of \
                 {rounds} rounds of {} s",
                self.workers,
                if self.workers == 1 { "" } else { "s" },
                format!("{:?}", self.level).to_lowercase(),
                self.seconds
            ),
            String::new(),
        ];
        for size in SIZES {
            lines.push(format!(
                "  {:<22} {:>11} {:>8}   {:<21} ours/this",
                format!("{} bytes", grouped(size.bytes as u64)),
                "segments/s",
                "MB/s",
                "from … to"
            ));
            lines.push(self.row(size.bytes, SHARED_MEMORY));
            lines.extend(peers().map(|name| self.row(size.bytes, name)));
            let Discrepancies { rejected, duplicate, lost, received } =
                self.discrepancies(size.bytes);
            let received = grouped(received);
            lines.push(format!(
                "  {received} received: {lost} lost, {duplicate} duplicate, {rejected} rejected"
            ));
            lines.push(String::new());
        }
        let blocked = self.blocked_cpu_fraction.map_or_else(
            || "an unknown fraction".to_owned(),
            |fraction| format!("{:.1} %", 100.0 * fraction),
        );
        lines.push(format!("  a blocked worker uses {blocked} of one core"));
        lines.push(String::new());
        lines.extend(self.notes.iter().map(|(name, text)| format!("  {name}: {text}")));
        lines.join("\n")
    }

    fn row(&self, bytes: usize, name: &str) -> String {
        let (rates, Some(rate)) = (self.rates(bytes, name), self.segments_per_s(bytes, name))
        else {
            return format!("  {name:<22} {:>11}", "absent");
        };
        let whole = |rate: f64| grouped(rate.round() as u64);
        let spread = format!("{} … {}", whole(min(rates)), whole(max(rates)));
        let ratio = self.ratio(bytes, name).filter(|_| name != SHARED_MEMORY);
        let ratio = ratio.map_or_else(String::new, |ratio| format!("{ratio:.2} ×"));
        let mb_per_s = rate * bytes as f64 / 1e6;
        let rate = whole(rate);
        let row = format!("  {name:<22} {rate:>11} {mb_per_s:>8.0}   {spread:<21} {ratio}");
        row.trim_end().to_owned()
    }
}

/// Returns the names of all peers, in the order of the report.
fn peers() -> impl Iterator<Item = &'static str> {
    StreamKind::ALL.map(StreamKind::name).into_iter().chain(python::NAMES)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn figures() -> Figures {
        let machine = Machine { os: "linux".into(), cpu: None, cores: 2, memory_bytes: None };
        let mut figures = Figures {
            workers: 1,
            level: DeliveryLevel::Memory,
            seconds: 0.4,
            machine,
            load_average: None,
            rounds: Vec::new(),
            sink_shares: vec![(1_024, 0.5)],
            notes: Vec::new(),
            discrepancies: vec![(1_024, Discrepancies { duplicate: 3, ..Default::default() })],
            blocked_cpu_fraction: Some(0.012),
        };
        figures.note("zeromq", "is not installed");
        figures.note("zeromq", "again");
        // The machine is four times slower in the second round, and twice in the third.
        for slow in [1.0, 4.0, 2.0] {
            figures.add(1_024, SHARED_MEMORY, 400_000.0 / slow);
            figures.add(1_024, "pipe", 100_000.0 / slow);
            figures.add(10_240, SHARED_MEMORY, 200_000.0 / slow);
        }
        figures
    }

    #[test]
    fn json_has_a_median_per_size_and_null_for_absent_peers() {
        let json = figures().json();
        let (small, large) = (&json["sizes"][0], &json["sizes"][1]);
        assert_eq!(
            (&small["segment_bytes"], &small["segments_per_s"]),
            (&1_024.into(), &2e5.into())
        );
        assert_eq!(
            (&large["segment_bytes"], &large["segments_per_s"]),
            (&10_240.into(), &1e5.into())
        );
        assert_eq!((&small["lost"], &small["duplicate"]), (&0.into(), &3.into()));
        assert_eq!(
            (&json["peers"]["pipe"], &small["to_peers"]["pipe"]),
            (&5e4.into(), &4.0.into())
        );
        assert!(json["peers"]["zeromq"].is_null() && large["peers"]["pipe"].is_null());
        assert_eq!(json["blocked_cpu_fraction"], 0.012);
        assert_eq!(json["notes"]["zeromq"], "is not installed");
    }

    #[test]
    fn table_shows_ratios_and_absent_peers() {
        let text = figures().text();
        let row = |name: &str| {
            let line = text.lines().find(|line| line.trim_start().starts_with(name)).unwrap();
            line.split_whitespace().skip(1).collect::<Vec<_>>().join(" ")
        };
        assert_eq!(row(SHARED_MEMORY), "200,000 205 100,000 … 400,000");
        assert_eq!(row("pipe"), "50,000 51 25,000 … 100,000 4.00 ×");
        assert_eq!(row("zeromq"), "absent");
        assert!(text.contains("0 lost, 3 duplicate"), "{text}");
        assert!(text.contains("uses 1.2 % of one core"), "{text}");
    }
}
