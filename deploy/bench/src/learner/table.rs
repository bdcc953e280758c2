//! Formats the figures of `bench learner` as a table.

use dmprl_run::format::grouped;
use dmprl_shared::config::Device;

use super::figures::{Figures, HANDOVER, KERNELS, LIBRARY, LIMIT, OURS};
use super::peers::PeerKind;
use crate::statistics::{max, min};

impl Figures {
    /// Returns the figures as a table.
    #[must_use]
    pub fn text(&self) -> String {
        let (algorithm, threads) = (&self.config.algorithm, self.config.learner.threads);
        let mut lines = vec![
            format!(
                "{} · {:?} · {:?} · batch {} · {threads} thread{}{}{}",
                self.config.task.name,
                algorithm.name,
                self.config.policy.kind,
                algorithm.batch_size,
                if threads == 1 { "" } else { "s" },
                if self.config.updates_by_graph() { " · graph" } else { "" },
                if self.config.learner.device == Device::Cuda { " · cuda" } else { "" }
            )
            .to_lowercase(),
            format!(
                "median of {} rounds of {} s, {}",
                self.rounds_len(),
                self.seconds,
                self.gpu.as_deref().or(self.cpu()).unwrap_or("unknown processor")
            ),
            String::new(),
            format!("  {:<15} {:>9} {:>9}   {:<19} ours", "", "ms/update", "CPU ms", "from … to"),
        ];
        let rows = [
            (OURS, "ours"),
            (KERNELS, "floor, ours"),
            (LIBRARY, "floor, library"),
            (LIMIT, "processor limit"),
        ];
        lines.extend(rows.iter().map(|(name, label)| self.row(name, label)));
        let peers = PeerKind::ALL.iter().map(|kind| kind.name());
        let requested = peers.filter(|name| self.notes.iter().any(|(noted, _)| noted == name));
        lines.extend(requested.map(|name| self.row(name, name)));
        lines.push(String::new());
        if let Some(ms) = self.ms(OURS) {
            let updates = 1e3 / ms;
            let samples = grouped((updates * algorithm.batch_size as f64).round() as u64);
            lines.push(format!("  {updates:.1} updates/s, {samples} samples/s"));
        }
        if let Some(shares) = self.shares() {
            let parts = shares.map(|(part, share)| format!("{part} {:.1} %", 100.0 * share));
            lines.push(format!("  share of time: {}", parts.join(", ")));
        }
        if let Some(ms) = self.ms(HANDOVER) {
            lines.push(format!("  a cache line goes from core to core in {:.0} ns", 1e6 * ms));
        }
        if let Some(bytes) = self.peak_memory_bytes {
            lines.push(format!("  peak memory {:.0} MB, replay included", bytes as f64 / 1e6));
        }
        lines.extend(self.notes.iter().map(|(name, text)| format!("  {name}: {text}")));
        lines.join("\n")
    }

    fn row(&self, name: &str, label: &str) -> String {
        let (Some(ms), Some(cpu_ms)) = (self.ms(name), self.cpu_ms(name)) else {
            return format!("  {label:<15} {:>9}", "absent");
        };
        let all = self.all_ms(name);
        let spread = format!("{:.3} … {:.3}", min(&all), max(&all));
        let ratio = match self.ratio_to_ours(name).filter(|_| name != OURS) {
            None => String::new(),
            Some(ratio) if ratio > 1.0 => format!("{ratio:.2} × faster"),
            Some(ratio) => format!("{:.2} × slower", 1.0 / ratio),
        };
        let row = format!("  {label:<15} {ms:>9.3} {cpu_ms:>9.3}   {spread:<19} {ratio}");
        row.trim_end().to_owned()
    }
}

#[cfg(test)]
mod tests {
    use crate::learner::figures::tests::figures;

    #[test]
    fn table_shows_ratios_and_absent_peers() {
        let text = figures().text();
        let row = |name: &str| {
            let line = text.lines().find(|line| line.trim_start().starts_with(name)).unwrap();
            line.split_whitespace().collect::<Vec<_>>().join(" ")
        };
        assert_eq!(row("ours"), "ours 10.000 5.000 5.000 … 20.000");
        assert_eq!(row("floor, ours"), "floor, ours 8.000 4.000 4.000 … 16.000 1.25 × slower");
        assert_eq!(row("torch"), "torch 16.000 8.000 8.000 … 32.000 1.60 × faster");
        assert_eq!(row("jax"), "jax absent");
        assert!(text.contains("100.0 updates/s, 12,800 samples/s"), "{text}");
        assert!(text.contains("products 80.0 %"), "{text}");
    }
}
