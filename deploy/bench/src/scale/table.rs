//! Formats the figures of `bench scale` as text.

use dmprl_run::format::grouped;

use super::figures::{Check, CostFigures, Figures, Simulated};
use super::model::Prediction;
use crate::drain_receiver::Discrepancies;

impl Figures {
    /// Returns the figures as tables.
    #[must_use]
    pub fn text(&self) -> String {
        let mut lines = self.simulation();
        lines.push(String::new());
        lines.extend(self.cost_lines());
        lines.push(String::new());
        lines.extend(self.model_lines());
        if !self.checks.is_empty() {
            lines.push(String::new());
            lines.extend(self.check_lines());
        }
        lines.join("\n")
    }

    fn simulation(&self) -> Vec<String> {
        let simulated = &self.simulated;
        let Simulated { window, discrepancies, .. } = simulated;
        let Discrepancies { rejected, duplicate, lost, received } = discrepancies;
        let (least, most) = simulated.shares();
        let memory = simulated.resident_mb().map(|mb| match mb {
            Some(mb) => format!("{mb:.0}"),
            None => "unknown".to_owned(),
        });
        vec![
            format!(
                "{} synthetic workers in {} process{} · segments of {} bytes · {:.1} s",
                window.segments.len(),
                self.feeders,
                if self.feeders == 1 { "" } else { "es" },
                grouped(self.segment_bytes as u64),
                window.seconds
            ),
            String::new(),
            format!("  segments/s       {:>11}", whole(simulated.segments_per_s())),
            format!(
                "  learner's thread {:>11.2} cores, {:.2} µs per segment, {:.2} µs without \
                 transport",
                simulated.learner_cores(),
                1e6 * simulated.cpu_s(),
                1e6 * simulated.insert_s
            ),
            format!(
                "  fairness         {:>11.4} Jain's index; {least:.2} to {most:.2} of an equal \
                 share",
                simulated.jain_index()
            ),
            format!("  memory           {:>11} MB at start, middle and end", memory.join(", ")),
            format!(
                "  {} received: {lost} lost, {duplicate} duplicate, {rejected} rejected",
                grouped(*received)
            ),
        ]
    }

    fn cost_lines(&self) -> Vec<String> {
        let CostFigures { worker_s, insert_s, log_s, update_s, update_cpu_s, .. } = self.costs;
        let demand = self.model.demand;
        let (actors, threads) = (&self.config.actors, self.config.learner.threads);
        let row = |name: &str, seconds: f64, what: &str| {
            format!("  {name:<10} {:>11.2}   {what}", 1e6 * seconds).trim_end().to_owned()
        };
        let steps = demand.steps_per_segment;
        vec![
            format!(
                "costs of {} · {:?} · {:?} · {} environments per worker · {} bytes per segment",
                self.config.task.name,
                self.config.algorithm.name,
                self.config.policy.kind,
                actors.envs_per_worker,
                grouped(demand.segment_bytes as u64)
            )
            .to_lowercase(),
            String::new(),
            "                      µs".to_owned(),
            row("worker", worker_s, &format!("per segment of {steps:.2} steps")),
            row("transport", self.costs.transport_s(), "per segment, in the learner"),
            row("ingest", insert_s, "per segment: check, settle, insert"),
            row("log", log_s, "more per segment at delivery level log"),
            row(
                "update",
                update_s,
                &format!(
                    "on {threads} thread{}, {:.2} µs of processor time; {} per segment",
                    if threads == 1 { "" } else { "s" },
                    1e6 * update_cpu_s,
                    demand.updates_per_segment
                ),
            ),
        ]
    }

    fn model_lines(&self) -> Vec<String> {
        let (bottleneck, workers) = self.first_bottleneck();
        let link = match self.link_bytes_per_s {
            Some(bytes) => format!("{:.1} Gbit/s into the learner's host", bytes * 8.0 / 1e9),
            None => "unlimited network".to_owned(),
        };
        let mut lines = vec![
            format!(
                "predictions for {} workers per host, the learner on its own host, {link}",
                self.cores_per_host
            ),
            String::new(),
            "  workers   hosts       steps/s   bottleneck   learner".to_owned(),
        ];
        let row = |it: &Prediction| {
            format!(
                "  {:>7}   {:>5}   {:>11}   {:<10}   {:>5.1} %",
                grouped(it.workers as u64),
                it.hosts,
                whole(it.steps_per_s),
                it.bottleneck.name(),
                100.0 * it.learner_utilisation
            )
        };
        lines.extend(self.predictions().iter().map(row));
        lines.push(format!(
            "  first bottleneck: {}, which {} worker{} reach{}",
            bottleneck.name(),
            grouped(workers as u64),
            if workers == 1 { "" } else { "s" },
            if workers == 1 { "es" } else { "" }
        ));
        lines
    }

    fn check_lines(&self) -> Vec<String> {
        let mut lines = vec![
            format!(
                "compared with real systems on the {} cores of this machine",
                self.machine.cores
            ),
            String::new(),
            "  workers   predicted   measured   ratio   CPU µs/step: predicted, measured, ratio"
                .to_owned(),
        ];
        let row = |check: &Check| {
            format!(
                "  {:>7}   {:>9}   {:>8}   {:>5.2}   {:>22.1}   {:>8.1}   {:>5.2}   {}",
                check.predicted.workers,
                whole(check.predicted.steps_per_s),
                whole(check.measured_steps_per_s),
                check.ratio(),
                1e6 * check.predicted_cpu_s,
                1e6 * check.measured_cpu_s,
                check.cpu_ratio(),
                check.predicted.bottleneck.name()
            )
        };
        lines.extend(self.checks.iter().map(row));
        lines
    }
}

fn whole(rate: f64) -> String {
    grouped(rate.round() as u64)
}

#[cfg(test)]
mod tests {
    use crate::scale::figures::tests::figures;

    #[test]
    fn tables_show_ingest_and_first_bottleneck() {
        let text = figures().text();
        for words in [
            "2 synthetic workers in 2 processes · segments of 1,024 bytes · 2.0 s",
            "200,000",
            "0.8000 Jain's index; 0.50 to 1.50 of an equal share",
            "200, 201, 201 MB at start, middle and end",
            "500,000 received: 0 lost, 0 duplicate, 0 rejected",
            "first bottleneck: ingest, which 334 workers reach",
        ] {
            assert!(text.contains(words), "{words}:\n{text}");
        }
        let row = text.lines().find(|line| line.trim_start().starts_with("1,024")).unwrap();
        let cells: Vec<_> = row.split_whitespace().collect();
        assert_eq!(cells, ["1,024", "65", "1,666,667", "ingest", "100.0", "%"]);
    }
}
