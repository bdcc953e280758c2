//! Joint positions and velocities of one rollout a method, as the paper's figures 6 and 7.

use anyhow::anyhow;

use super::collect::Results;
use super::moves::Rollout;
use super::run::Run;
use super::sections::Picture;
use crate::plots::{Panel, SmallMultiples, colour};
use crate::run_directory::safe_name;

/// One method's rollout.
struct Shown<'r> {
    /// The method's place in the report.
    index: usize,
    run: &'r Run,
    rollout: &'r Rollout,
}

/// Two pictures a task whose joints are known: the same episode for every method.
///
/// # Errors
/// A picture cannot be drawn.
pub fn trajectories(results: &Results) -> anyhow::Result<Vec<Picture>> {
    let mut pictures = Vec::new();
    for task in &results.tasks {
        let shown = shown(results, task);
        let Some(first) = shown.first().map(|shown| shown.rollout) else { continue };
        let unit = &first.unit;
        for (what, unit, rows) in [
            ("position", unit.clone(), positions as fn(&Rollout) -> &[Vec<f64>]),
            ("velocity", format!("{unit}/s"), velocities),
        ] {
            let panels = shown.iter().map(|shown| panel(shown, rows));
            let title = format!("{task}: joint {what}, episode of seed {}", first.seed);
            let time = if first.control_dt_s > 0.0 { "time [s]" } else { "steps" };
            let drawn = SmallMultiples {
                title: &title,
                axes: [time, &format!("joint {what} [{unit}]")],
                names: &first.joints,
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

/// Whether the run is the one that stands for its method.
#[must_use]
pub fn is_drawn(results: &Results, run: &Run) -> bool {
    shown(results, &run.task).iter().any(|shown| std::ptr::eq(shown.run, run))
}

/// Methods that have no panel though a landed run of theirs once had joints: an earlier report
/// keeps the rollout of no run but the one that it drew.
#[must_use]
pub fn lost_trajectories(results: &Results) -> Vec<String> {
    let mut lost = Vec::new();
    for task in &results.tasks {
        let shown = shown(results, task);
        for method in &results.methods {
            let had_joints = |run: &Run| {
                let jerk = run.motion.as_ref().and_then(|motion| motion.joint_jerk);
                run.directory().is_none() && jerk.is_some()
            };
            let is_shown = shown.iter().any(|shown| shown.run.method == *method);
            if !is_shown && results.of(task, method).any(had_joints) {
                lost.push(format!("joints of {task} · {method}: no rollout was landed"));
            }
        }
    }
    lost
}

fn positions(rollout: &Rollout) -> &[Vec<f64>] {
    &rollout.positions
}

fn velocities(rollout: &Rollout) -> &[Vec<f64>] {
    &rollout.velocities
}

/// Of each method the first run whose rollout is at hand; of the same robot and episode as the
/// first method's.
fn shown<'r>(results: &'r Results, task: &str) -> Vec<Shown<'r>> {
    let mut all: Vec<Shown<'r>> = Vec::new();
    for (index, method) in results.methods.iter().enumerate() {
        let mut runs: Vec<&Run> =
            results.runs.iter().filter(|run| run.task == task && run.method == *method).collect();
        runs.sort_by_key(|run| run.seed);
        let measured = runs.into_iter().find_map(|run| {
            let rollout = run.motion.as_ref()?.rollout.as_ref()?;
            let comparable = all.first().is_none_or(|first| first.rollout.is_beside(rollout));
            comparable.then_some((run, rollout))
        });
        all.extend(measured.map(|(run, rollout)| Shown { index, run, rollout }));
    }
    all
}

fn panel(Shown { index, run, rollout }: &Shown<'_>, rows: fn(&Rollout) -> &[Vec<f64>]) -> Panel {
    let (times, rows) = (rollout.times(), rows(rollout));
    let line = |joint: usize| -> Vec<(f64, f64)> {
        times.iter().copied().zip(rows.iter().map(|row| row[joint])).collect()
    };
    Panel {
        title: format!("{}, seed {}", run.method, run.seed),
        colour: colour(*index, &run.method),
        lines: (0..rollout.joints.len()).map(line).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::super::planted::{Planted, planted, planted_moves};
    use super::super::run::Source;
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
            run.motion = Some(planted_moves(3.0, -2.0));
        }
        // Of another episode, and never measured.
        let other = results.runs[3].motion.as_mut().unwrap();
        other.rollout.as_mut().unwrap().seed += 1;
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
    #[test]
    fn a_landed_run_whose_rollout_was_not_kept_is_told_and_one_of_another_seed_stands_in() {
        let run = |method, seed| Planted {
            task: "pusher-v0",
            method,
            seed,
            rows: vec![-40.0],
            ended: true,
        };
        let mut results = planted(&[run("SAC", 1), run("SAC", 2), run("TD3", 1), run("NDP", 1)]);
        for (index, run) in results.runs.iter_mut().enumerate() {
            let mut moves = planted_moves(3.0, -2.0);
            if index != 1 {
                moves.rollout = None;
            }
            run.motion = Some(moves);
            run.source = Source::Report("earlier".into());
        }
        // Of an environment that shows no joints.
        results.runs[3].motion.as_mut().unwrap().joint_jerk = None;
        assert_eq!(
            lost_trajectories(&results),
            ["joints of pusher-v0 · TD3: no rollout was landed"]
        );
        let drawn = [0, 1, 2].map(|index| is_drawn(&results, &results.runs[index]));
        assert_eq!(drawn, [false, true, false]);
    }
}
