//! System, processor, memory, disk and graphics.

use std::path::Path;

use dmprl_run::Machine;
use dmprl_run::format::binary_bytes;
use dmprl_supervisor::answer;
use dmprl_supervisor::capacity::{MachineLimits, Space};
use rustix::fs::{Access, access};

use super::Check;

/// Where `train` puts its runs.
const RUNS: &str = "runs";
/// Where the kernel was last asked about its name.
const KERNEL_RELEASE: &str = "/proc/sys/kernel/osrelease";
/// Learner with its replay, and a worker with MuJoCo; less than that swaps or is killed.
const MEMORY_BYTES_MIN: u64 = 2 << 30;
/// A checkpoint with the replay of a default run.
const DISK_BYTES_MIN: u64 = 1 << 30;

pub(super) fn checks() -> Vec<Check> {
    vec![platform(), cores(), memory(), disk(), gpu()]
}

fn platform() -> Check {
    let release = std::fs::read_to_string(KERNEL_RELEASE).unwrap_or_default();
    let (os, processor) = (std::env::consts::OS, std::env::consts::ARCH);
    let found = format!("{os} {} on {processor}", release.trim());
    if os == "linux" && ["x86_64", "aarch64"].contains(&processor) {
        return Check::ok("platform", found);
    }
    Check::problem("platform", found, "supported is Linux on x86_64 and aarch64")
}

fn cores() -> Check {
    let Machine { cores, cpu, .. } = Machine::this();
    let found = match cpu {
        Some(cpu) => format!("{cores}, {cpu}"),
        None => cores.to_string(),
    };
    if cores == 1 {
        let advice = "learner and worker share it: runs work, at half the speed";
        return Check::warning("cores", found, advice);
    }
    Check::ok("cores", found)
}

fn memory() -> Check {
    let Some(bytes) = MachineLimits::this().memory_bytes else {
        return Check::warning("memory", "not known", "the kernel shows no /proc/meminfo");
    };
    let found = binary_bytes(bytes);
    if bytes < MEMORY_BYTES_MIN {
        let advice = format!(
            "below {}, learner and workers may be killed: lower replay.capacity_steps and \
             actors.workers, or raise the container's limit",
            binary_bytes(MEMORY_BYTES_MIN)
        );
        return Check::warning("memory", found, advice);
    }
    Check::ok("memory", found)
}

fn disk() -> Check {
    let here = std::env::current_dir().unwrap_or_default();
    let runs = here.join(RUNS);
    // Not made yet, it will lie in the current directory's file system.
    let path = if runs.is_dir() { runs } else { here };
    disk_at(&path)
}

fn disk_at(path: &Path) -> Check {
    let space = match Space::of(path) {
        Ok(space) => space,
        Err(error) => {
            let advice = "start dmprl in a directory that exists";
            return Check::problem("disk", format!("{}: {error}", path.display()), advice);
        }
    };
    let found = format!("{} free in {}", binary_bytes(space.free_bytes), path.display());
    if let Err(error) = access(path, Access::WRITE_OK) {
        let advice = "start dmprl in a directory of your own, or give train a --run-dir";
        return Check::warning("disk", format!("{found}, but not for writing: {error}"), advice);
    }
    if space.free_bytes < DISK_BYTES_MIN {
        let advice = format!(
            "checkpoints may not fit into less than {}: checkpoint.keep and \
             checkpoint.disk_bytes_max bound them",
            binary_bytes(DISK_BYTES_MIN)
        );
        return Check::warning("disk", found, advice);
    }
    Check::ok("disk", found)
}

fn gpu() -> Check {
    let query = ["--query-gpu=name,memory.total,driver_version", "--format=csv,noheader"];
    let gpus = answer("nvidia-smi", &query).map(|text| text.replace('\n', "; "));
    gpu_check(gpus.ok().filter(|text| !text.is_empty()), cfg!(feature = "cuda"))
}

fn gpu_check(gpu: Option<String>, built_with_cuda: bool) -> Check {
    match (gpu, built_with_cuda) {
        (Some(gpu), true) => Check::ok("gpu", format!("{gpu}; used by --device cuda")),
        (Some(gpu), false) => Check::ok(
            "gpu",
            format!("{gpu}; this build is without CUDA (cargo build --release --features cuda)"),
        ),
        (None, true) => Check::warning(
            "gpu",
            "none, although this build has CUDA",
            "nvidia-smi answers nothing: is the driver installed? --device cpu works",
        ),
        (None, false) => Check::ok("gpu", "none; nothing needs one"),
    }
}

#[cfg(test)]
mod tests {
    use super::super::Status;
    use super::*;

    #[test]
    fn a_build_for_a_gpu_that_is_not_there_is_worth_a_warning() {
        let gpu = || Some("NVIDIA H200".to_owned());
        assert_eq!(gpu_check(None, false).status, Status::Ok);
        assert_eq!(gpu_check(None, true).status, Status::Warning);
        assert!(gpu_check(gpu(), false).found.contains("--features cuda"));
        assert!(gpu_check(gpu(), true).found.contains("H200"));
    }

    #[test]
    fn a_directory_that_is_gone_is_a_problem() {
        let folder = tempfile::tempdir().unwrap();
        assert_ne!(disk_at(folder.path()).status, Status::Problem);
        assert_eq!(disk_at(&folder.path().join("gone")).status, Status::Problem);
    }
}
