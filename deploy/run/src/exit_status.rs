//! Describes how a process ended.

use std::os::unix::process::ExitStatusExt;
use std::process::ExitStatus;

/// Exit status of a process that ended itself because an environment hung.
pub const ENV_HUNG_STATUS: i32 = 75;
/// Exit status of a program that panicked.
pub const PANIC_STATUS: i32 = 101;

/// Describes an exit status, such as `exit status 3` or `signal 9 (SIGKILL), perhaps out of
/// memory`.
#[must_use]
pub fn describe(status: ExitStatus) -> String {
    let signal = match (status.code(), status.signal()) {
        (Some(ENV_HUNG_STATUS), _) => {
            return format!("exit status {ENV_HUNG_STATUS}, an environment hung");
        }
        (Some(code), _) => return format!("exit status {code}"),
        (None, Some(signal)) => signal,
        (None, None) => return status.to_string(),
    };
    let name = match signal {
        4 => " (SIGILL), an instruction that this processor does not support",
        6 => " (SIGABRT)",
        7 => " (SIGBUS), perhaps because shared memory (/dev/shm) is full",
        9 => " (SIGKILL), perhaps out of memory",
        11 => " (SIGSEGV), a fault in native code",
        15 => " (SIGTERM)",
        _ => "",
    };
    format!("signal {signal}{name}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_exit_is_described_with_its_likely_cause() {
        assert_eq!(describe(ExitStatus::from_raw(3 << 8)), "exit status 3");
        assert!(describe(ExitStatus::from_raw(75 << 8)).contains("an environment hung"));
        assert!(describe(ExitStatus::from_raw(9)).contains("SIGKILL"));
        assert!(describe(ExitStatus::from_raw(7)).contains("/dev/shm"));
    }
}
