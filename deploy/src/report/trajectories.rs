//! Joint positions and velocities of one rollout a method, as the paper's figures 6 and 7.

use anyhow::anyhow;

use super::collect::{Results, Run};
use super::sections::Picture;
use crate::motion::Motion;
use crate::plots::{Panel, SmallMultiples, colour};
use crate::run_directory::safe_name;

/// One method's rollout.
struct Rollout<'r> {
    /// The method's place in the report.
    index: usize,
    run: &'r Run,
    motion: &'r Motion,
}

/// Two pictures a task whose joints are known: the same episode for every method.
///
/// # Errors
/// A picture cannot be drawn.
pub fn trajectories(results: &Results) -> anyhow::Result<Vec<Picture>> {
    let mut pictures = Vec::new();
    for task in &results.tasks {
        let rollouts = rollouts(results, task);
        let Some(first) = rollouts.first().map(|rollout| rollout.motion) else { continue };
        let unit = &first.unit;
        for (what, unit, rows) in [
            ("position", unit.clone(), positions as fn(&Motion) -> &[Vec<f64>]),
            ("velocity", format!("{unit}/s"), velocities),
        ] {
            let joints = counted(first);
            let names: Vec<String> =
                joints.iter().map(|joint| first.robot.joints[*joint].name.clone()).collect();
            let panels = rollouts.iter().map(|rollout| panel(rollout, &joints, rows));
            let title = format!("{task}: joint {what}, episode of seed {}", first.first_seed);
            let time = if first.robot.control_dt_s > 0.0 { "time [s]" } else { "steps" };
            let drawn = SmallMultiples {
                title: &title,
                axes: [time, &format!("joint {what} [{unit}]")],
                names: &names,
                panels: panels.collect(),
            };
            let svg = drawn
                .draw()
                .map_err(|error| anyhow!("cannot draw the joints of {task}: {error}"))?;
            let path = format!("joints/{}-{what}", safe_name(task));
            pictures.push(Picture { path, alt: title, svg });
        }
    }
    Ok(pictures)
}

fn positions(motion: &Motion) -> &[Vec<f64>] {
    &motion.episode.joint_positions
}

fn velocities(motion: &Motion) -> &[Vec<f64>] {
    &motion.episode.joint_velocities
}

/// Of each method the first run that was measured; of the same robot and episode as the first
/// method's.
fn rollouts<'r>(results: &'r Results, task: &str) -> Vec<Rollout<'r>> {
    let mut rollouts: Vec<Rollout<'r>> = Vec::new();
    for (index, method) in results.methods.iter().enumerate() {
        let mut runs: Vec<&Run> =
            results.runs.iter().filter(|run| run.task == task && run.method == *method).collect();
        runs.sort_by_key(|run| run.seed);
        let measured = runs.into_iter().find_map(|run| {
            let motion = run.motion.as_ref().filter(|motion| !counted(motion).is_empty())?;
            let comparable = rollouts.first().is_none_or(|first| {
                (first.motion.first_seed, &first.motion.robot) == (motion.first_seed, &motion.robot)
            });
            comparable.then_some((run, motion))
        });
        rollouts.extend(measured.map(|(run, motion)| Rollout { index, run, motion }));
    }
    rollouts
}

/// Joints that are measured in the same unit.
fn counted(motion: &Motion) -> Vec<usize> {
    let joints = motion.robot.joints.iter().enumerate();
    let counted = joints.filter(|(_, joint)| joint.kind.unit() == motion.unit);
    counted.map(|(index, _)| index).collect()
}

fn panel(rollout: &Rollout<'_>, joints: &[usize], rows: fn(&Motion) -> &[Vec<f64>]) -> Panel {
    let Rollout { index, run, motion } = rollout;
    let (times, rows) = (motion.times(), rows(motion));
    let line = |joint: usize| -> Vec<(f64, f64)> {
        times.iter().copied().zip(rows.iter().map(|row| row[joint])).collect()
    };
    Panel {
        title: format!("{}, seed {}", run.method, run.seed),
        colour: colour(*index, &run.method),
        lines: joints.iter().map(|joint| line(*joint)).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::super::planted::{Planted, planted, planted_motion};
    use super::*;

    #[test]
    fn every_method_has_a_panel_of_the_same_episode_and_slides_stand_in_none() {
        let run = |method, seed| Planted {
            task: "pusher-v0",
            method,
            seed,
            rows: vec![-40.0],
            ended: true,
        };
        let mut results =
            planted(&[run("DDPG", 2), run("DDPG", 1), run("SAC", 3), run("TD3", 1), run("NDP", 1)]);
        for run in results.runs.iter_mut().take(4) {
            run.motion = Some(planted_motion(3.0, -2.0));
        }
        // Of another episode, and never measured.
        results.runs[3].motion.as_mut().unwrap().first_seed += 1;
        let pictures = trajectories(&results).unwrap();
        let paths: Vec<_> = pictures.iter().map(|picture| picture.path.as_str()).collect();
        assert_eq!(paths, ["joints/pusher-v0-position", "joints/pusher-v0-velocity"]);
        let svg = &pictures[1].svg;
        for text in ["joint velocity [rad/s]", "time [s]", "DDPG, seed 1", "SAC, seed 3", "elbow"] {
            assert!(svg.contains(text), "{text} is missing");
        }
        for text in ["TD3", "NDP", "seed 2", "finger"] {
            assert!(!svg.contains(text), "{text} is there");
        }
        assert!(pictures[0].svg.contains("joint position [rad]"));
    }

    #[test]
    fn without_motion_there_is_no_picture() {
        let run =
            Planted { task: "pusher-v0", method: "SAC", seed: 1, rows: vec![-40.0], ended: true };
        assert!(trajectories(&planted(&[run])).unwrap().is_empty());
    }
}
