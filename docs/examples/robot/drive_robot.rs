//! Drives a robot at control rate with a trained policy, in Rust.
//!
//! A program of the robot is at the other end of the pipes. It writes one observation per line to
//! standard input, numbers separated by spaces, and reads one action per line from standard output.
//! SIGINT, SIGTERM, SIGHUP, the end of the input and errors end the drive with the hold.

use std::error::Error;
use std::io::{Write, stdin, stdout};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::{Duration, Instant};
use std::{env, thread};

use dmprl_runtime::PolicyRuntime;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

/// Longest time between two control steps, in control steps.
const DEADLINE_STEPS: f64 = 5.0;
/// Observations that wait for the policy. It uses the newest one.
const WAITING_MAX: usize = 100;

type Failure = Box<dyn Error + Send + Sync>;

fn main() -> Result<(), Failure> {
    let mut arguments = env::args().skip(1);
    let usage = "expected POLICY RATE HZ: a file exported with --hold, the largest change of an \
                 action per control step, and the control rate [Hz]";
    let (Some(file), Some(rate), Some(hz)) = (arguments.next(), arguments.next(), arguments.next())
    else {
        return Err(usage.into());
    };
    let mut policy = PolicyRuntime::load(file.as_ref())?;
    let rate = vec![rate.parse()?; policy.spec().action_len];
    drive(&mut policy, &rate, 1.0 / hz.parse::<f64>()?)
}

/// Drives until a signal, an error, or the end of the input.
pub fn drive(policy: &mut PolicyRuntime, rate: &[f64], step_s: f64) -> Result<(), Failure> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM, SIGHUP] {
        signal_hook::flag::register(signal, Arc::clone(&stop))?;
    }
    let step = Duration::try_from_secs_f64(step_s)?;
    // A policy without a hold is rejected here, before anything moves.
    policy.safety_mut().set_rate(rate)?;
    let start = Instant::now();
    policy.set_deadline(DEADLINE_STEPS * step_s, move || start.elapsed().as_secs_f64())?;
    policy.reset(None)?;
    let observations = read_observations();
    let driven = control_steps(policy, &observations, step, &stop);
    let held = policy.hold_until_reached::<Failure>(|action| {
        send(action)?;
        thread::sleep(step);
        Ok(())
    });
    if let Err(error) = held {
        return Err(format!("the robot did not get the hold: {error}").into());
    }
    driven
}

/// Runs control steps until `stop` is set or the input ends.
fn control_steps(
    policy: &mut PolicyRuntime,
    observations: &Receiver<Vec<f64>>,
    step: Duration,
    stop: &AtomicBool,
) -> Result<(), Failure> {
    while !stop.load(Ordering::Relaxed) {
        // The robot sets the pace; if it falls silent, the timeout does.
        let observation = match observations.recv_timeout(step) {
            Ok(first) => Some(observations.try_iter().last().unwrap_or(first)),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => return Err("the robot has hung up".into()),
        };
        let action = match policy.action(observation.as_deref()) {
            Ok(action) => action,
            Err(error) => {
                eprintln!("{error}");
                policy.hold()?
            }
        };
        send(action)?;
    }
    Ok(())
}

/// Reads observations in a thread, so that a silent robot does not block the control loop.
fn read_observations() -> Receiver<Vec<f64>> {
    let (sender, receiver) = sync_channel(WAITING_MAX);
    thread::spawn(move || {
        for line in stdin().lines().map_while(Result::ok) {
            // A number that cannot be read becomes NaN, which the policy rejects.
            let numbers = line.split_whitespace().map(|word| word.parse().unwrap_or(f64::NAN));
            if sender.send(numbers.collect()).is_err() {
                break;
            }
        }
    });
    receiver
}

/// Sends a command to the robot.
fn send(action: &[f64]) -> Result<(), Failure> {
    let numbers: Vec<String> = action.iter().map(f64::to_string).collect();
    let mut robot = stdout().lock();
    writeln!(robot, "{}", numbers.join(" "))?;
    Ok(robot.flush()?)
}
