//! Runs a trained policy in a robot's control loop.

use dmprl_shared::runtime::{PolicyRuntime, RuntimeError};

fn main() -> Result<(), RuntimeError> {
    let mut policy = PolicyRuntime::load("policy.safetensors".as_ref())?;
    policy.reset(None)?;
    for _ in 0..1_000 {
        // Once per control step: the robot's observation, or `None` if there is no new one.
        let observation = vec![0.0; policy.spec().observation_len];
        let action = policy.action(Some(&observation))?;
        println!("{action:?}"); // to the robot
    }
    Ok(())
}
