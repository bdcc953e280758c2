//! Asks the driver for the machine's NVIDIA GPUs.

use crate::answer;

/// Returns name, memory and driver of each GPU, or `None` if there is none or no driver.
#[must_use]
pub fn gpus() -> Option<String> {
    let query = ["--query-gpu=name,memory.total,driver_version", "--format=csv,noheader"];
    let gpus = answer("nvidia-smi", &query).ok()?;
    Some(gpus.replace('\n', "; ")).filter(|text| !text.is_empty())
}
