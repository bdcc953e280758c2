//! Checks that this machine has enough resources for a run.
//!
//! The check runs before any process is started, because a shortage would end the run later, often
//! without an explanation.

mod machine;
mod need;

use anyhow::bail;
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::spec::EnvSpec;

pub use machine::{MachineLimits, Space};
pub use need::Need;

use dmprl_run::format::binary_bytes;

/// Rejects a run that exceeds this machine's resources.
///
/// `spec` is `None` if only a worker can determine it. In this case the smallest environment is
/// assumed, and the learner later rejects one that is too large.
///
/// # Errors
/// The shortages, each with the required and the available amount and a remedy.
pub fn check(config: &ExperimentConfig, spec: Option<&EnvSpec>) -> anyhow::Result<()> {
    let machine = MachineLimits::this();
    let shortages = Need::of(config, spec).shortages(&machine);
    if shortages.is_empty() {
        return Ok(());
    }
    bail!("the run exceeds this machine's resources\n  {}", shortages.join("\n  "))
}

impl Need {
    /// Formats the number of workers, as part of a sentence.
    pub fn counted(&self) -> String {
        let Self { workers, joined, remote, .. } = self;
        let mut counted = format!("{workers} worker{}", if *workers == 1 { "" } else { "s" });
        if *joined > 0 {
            counted += &format!(" and {joined} that may join (actors.joined_max)");
        }
        if *remote > 0 {
            counted += &format!(" and {remote} of other hosts (bridge.workers_max)");
        }
        counted
    }

    /// Describes each shortage of the machine in one sentence.
    pub fn shortages(&self, machine: &MachineLimits) -> Vec<String> {
        let mut shortages = Vec::new();
        let Self { shared_memory_bytes, replay_bytes, open_files, maps, tasks, .. } = *self;
        let counted = self.counted();
        if let Some(Space { path, free_bytes, .. }) = &machine.shared_memory
            && *free_bytes < shared_memory_bytes
        {
            shortages.push(format!(
                "shared memory: {} needed for {counted}, {} free in {}: use fewer workers, \
                 shorter queues (actors.queue_segments), or enlarge it (Docker: --shm-size)",
                binary_bytes(shared_memory_bytes),
                binary_bytes(*free_bytes),
                path.display()
            ));
        }
        if let Some(limit) = machine.open_files.filter(|&limit| limit < open_files) {
            shortages.push(format!(
                "open files: {open_files} needed in one process for {counted}, the limit is \
                 {limit}: raise it (ulimit -n {open_files}), or use fewer workers"
            ));
        }
        if let Some(limit) = machine.maps.filter(|&limit| limit < maps) {
            shortages.push(format!(
                "memory maps: {maps} needed in one process for {counted}, the limit is {limit}: \
                 raise it (sysctl -w vm.max_map_count={maps}), or use fewer workers"
            ));
        }
        if let Some(limit) = machine.tasks.filter(|&limit| limit < tasks) {
            shortages.push(format!(
                "processes and threads: {tasks} needed for {counted}, the limit is {limit}: raise \
                 it (ulimit -u, or the container's pids limit), or use fewer workers"
            ));
        }
        let memory_bytes = replay_bytes.saturating_add(shared_memory_bytes);
        if let Some(limit) = machine.memory_bytes.filter(|&limit| limit < memory_bytes) {
            shortages.push(format!(
                "memory: {} needed for the replay and {} of shared memory, this machine or its \
                 container has {}: lower replay.capacity_steps",
                binary_bytes(replay_bytes),
                binary_bytes(shared_memory_bytes),
                binary_bytes(limit)
            ));
        }
        shortages
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NEED: Need = Need {
        workers: 4,
        joined: 0,
        remote: 0,
        shared_memory_bytes: 5 << 20,
        replay_bytes: 1 << 30,
        open_files: 112,
        maps: 1_100,
        tasks: 40,
    };

    fn machine() -> MachineLimits {
        MachineLimits {
            shared_memory: Some(Space {
                path: "/dev/shm".into(),
                size_bytes: 64 << 20,
                free_bytes: 5 << 20,
            }),
            open_files: Some(112),
            maps: Some(1_100),
            tasks: Some(40),
            memory_bytes: Some((1 << 30) + (5 << 20)),
        }
    }

    #[test]
    fn a_run_that_just_fits_is_accepted() {
        assert_eq!(NEED.shortages(&machine()), Vec::<String>::new());
        let unlimited = MachineLimits {
            shared_memory: None,
            open_files: None,
            maps: None,
            tasks: None,
            memory_bytes: None,
        };
        assert_eq!(NEED.shortages(&unlimited), Vec::<String>::new());
    }

    #[test]
    fn each_shortage_has_both_numbers_and_a_remedy() {
        let space = Space { free_bytes: 1 << 20, ..machine().shared_memory.unwrap() };
        let short = MachineLimits {
            shared_memory: Some(space),
            open_files: Some(64),
            maps: Some(1_000),
            tasks: Some(39),
            memory_bytes: Some(1 << 29),
        };
        let shortages = NEED.shortages(&short);
        for (shortage, words) in shortages.iter().zip([
            ["5 MiB needed for 4 workers", "1 MiB free in /dev/shm", "--shm-size"],
            ["112 needed", "the limit is 64", "ulimit -n 112"],
            ["1100 needed", "the limit is 1000", "vm.max_map_count=1100"],
            ["40 needed", "the limit is 39", "ulimit -u"],
            ["1 GiB needed", "512 MiB", "replay.capacity_steps"],
        ]) {
            words.iter().for_each(|words| assert!(shortage.contains(words), "{shortage}"));
        }
        assert_eq!(shortages.len(), 5, "{shortages:#?}");
    }
}
