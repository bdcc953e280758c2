//! Checks of platform, processor, memory, disk and GPU.

use std::path::{Path, PathBuf};

use dmprl_run::format::binary_bytes;
use dmprl_run::{FileSystem, Machine};
use dmprl_supervisor::capacity::{MachineLimits, Space};
use dmprl_supervisor::gpus;
use rustix::fs::{Access, access};

use super::Check;

/// Default parent directory of runs.
const RUNS: &str = "runs";
/// File with the kernel's version.
const KERNEL_RELEASE: &str = "/proc/sys/kernel/osrelease";
/// Needed by a learner with its replay and a worker with MuJoCo.
const MEMORY_BYTES_MIN: u64 = 2 << 30;
/// Needed by a checkpoint with the replay of a default run.
const DISK_BYTES_MIN: u64 = 1 << 30;

pub(super) fn checks() -> Vec<Check> {
    vec![platform(), cores(), memory(), disk(), file_system(), gpu()]
}

fn platform() -> Check {
    let release = std::fs::read_to_string(KERNEL_RELEASE).unwrap_or_default();
    let (os, processor) = (std::env::consts::OS, std::env::consts::ARCH);
    let found = format!("{os} {} on {processor}", release.trim());
    if os == "linux" && ["x86_64", "aarch64"].contains(&processor) {
        return Check::ok("platform", found);
    }
    Check::problem("platform", found, "only Linux on x86_64 and aarch64 is supported")
}

fn cores() -> Check {
    let Machine { cores, cpu, .. } = Machine::this();
    let found = match cpu {
        Some(cpu) => format!("{cores}, {cpu}"),
        None => cores.to_string(),
    };
    if cores == 1 {
        let advice = "runs work, but slowly: learner and worker share the core";
        return Check::warning("cores", found, advice);
    }
    Check::ok("cores", found)
}

fn memory() -> Check {
    let Some(bytes) = MachineLimits::this().memory_bytes else {
        return Check::warning("memory", "unknown", "/proc/meminfo cannot be read");
    };
    let found = binary_bytes(bytes);
    if bytes < MEMORY_BYTES_MIN {
        let advice = format!(
            "with less than {}, learner and workers may be killed: lower replay.capacity_steps and \
             actors.workers, or raise the container's limit",
            binary_bytes(MEMORY_BYTES_MIN)
        );
        return Check::warning("memory", found, advice);
    }
    Check::ok("memory", found)
}

fn disk() -> Check {
    disk_at(&runs_folder())
}

/// Folder in which `train` creates runs.
fn runs_folder() -> PathBuf {
    let here = std::env::current_dir().unwrap_or_default();
    let runs = here.join(RUNS);
    // If it does not exist yet, `train` creates it in the current directory.
    if runs.is_dir() { runs } else { here }
}

fn file_system() -> Check {
    const NAME: &str = "file system";
    let path = runs_folder();
    match FileSystem::of(&path) {
        Ok(found) => file_system_check(&found, &path),
        Err(error) => Check::warning(NAME, error.to_string(), "use train --run-dir"),
    }
}

fn file_system_check(found: &FileSystem, path: &Path) -> Check {
    let text = format!("{found}, of {}", path.display());
    match found.concern() {
        Some(concern) => Check::warning("file system", text, concern),
        None => Check::ok("file system", text),
    }
}

fn disk_at(path: &Path) -> Check {
    let space = match Space::of(path) {
        Ok(space) => space,
        Err(error) => {
            let advice = "run dmprl in a directory that exists";
            return Check::problem("disk", format!("{}: {error}", path.display()), advice);
        }
    };
    let found = format!("{} free in {}", binary_bytes(space.free_bytes), path.display());
    if let Err(error) = access(path, Access::WRITE_OK) {
        let advice = "run dmprl in a directory of your own, or use train --run-dir";
        return Check::warning("disk", format!("{found}, but not writable: {error}"), advice);
    }
    if space.free_bytes < DISK_BYTES_MIN {
        let advice = format!(
            "checkpoints may need more than {}: limit them with checkpoint.keep and \
             checkpoint.disk_bytes_max",
            binary_bytes(DISK_BYTES_MIN)
        );
        return Check::warning("disk", found, advice);
    }
    Check::ok("disk", found)
}

fn gpu() -> Check {
    gpu_check(gpus(), cfg!(feature = "cuda"))
}

fn gpu_check(gpu: Option<String>, built_with_cuda: bool) -> Check {
    match (gpu, built_with_cuda) {
        (Some(gpu), true) => Check::ok("gpu", format!("{gpu}; used by --device cuda")),
        (Some(gpu), false) => Check::ok(
            "gpu",
            format!("{gpu}; not used, as this build has no CUDA (cargo build --features cuda)"),
        ),
        (None, true) => Check::warning(
            "gpu",
            "none, although this build has CUDA",
            "nvidia-smi reports no GPU; check that the driver is installed, or use --device cpu",
        ),
        (None, false) => Check::ok("gpu", "none; not needed by this build"),
    }
}

#[cfg(test)]
mod tests {
    use super::super::Status;
    use super::*;

    #[test]
    fn a_cuda_build_without_a_gpu_gets_a_warning() {
        let gpu = || Some("NVIDIA H200".to_owned());
        assert_eq!(gpu_check(None, false).status, Status::Ok);
        assert_eq!(gpu_check(None, true).status, Status::Warning);
        assert!(gpu_check(gpu(), false).found.contains("--features cuda"));
        assert!(gpu_check(gpu(), true).found.contains("H200"));
    }

    #[test]
    fn a_missing_directory_is_a_problem() {
        let folder = tempfile::tempdir().unwrap();
        assert_ne!(disk_at(folder.path()).status, Status::Problem);
        assert_eq!(disk_at(&folder.path().join("gone")).status, Status::Problem);
    }
}
