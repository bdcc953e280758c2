//! A trained policy acts next to a robot.

use dmprl_shared::runtime::{PolicyRuntime, RuntimeError};

fn main() -> Result<(), RuntimeError> {
    let mut policy = PolicyRuntime::load("policy.safetensors".as_ref())?;
    policy.reset(None)?;
    for _ in 0..1_000 {
        // Once a control step: the robot's observation, or None if none has come since.
        let observation = vec![0.0; policy.spec().observation_len];
        let action = policy.action(Some(&observation))?;
        println!("{action:?}"); // to the robot
    }
    Ok(())
}
