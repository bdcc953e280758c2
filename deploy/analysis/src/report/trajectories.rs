//! Draws the joint trajectories of a rollout of each method, as in the paper's Figures 6 and 7.

use anyhow::anyhow;
use dmprl_run::safe_name;
use plotters::style::RGBColor;

use super::families;
use super::layout::Picture;
use super::motion_metrics::Rollout;
use super::results::{Results, ShownRollout};
use super::run::Run;
use crate::plots::{Panel, SmallMultiples};

/// Draws joint positions and velocities for each task whose joints are known. The pictures of a
/// task show the same episode for every method.
///
/// # Errors
/// A picture cannot be drawn.
pub fn trajectories(results: &Results) -> anyhow::Result<Vec<Picture>> {
    let (mut pictures, colours) = (Vec::new(), results.colours());
    for task in &results.tasks {
        let shown = results.shown_rollouts(task);
        let Some(first) = shown.first().map(|shown| shown.rollout) else { continue };
        let unit = &first.unit;
        for (what, unit, rows) in [
            ("position", unit.clone(), positions as fn(&Rollout) -> &[Vec<f64>]),
            ("velocity", format!("{unit}/s"), velocities),
        ] {
            let panels = shown.iter().map(|shown| panel(shown, &colours, rows));
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

/// Lists the methods that have no panel although an earlier report measured their motion. This
/// happens because a report keeps only the rollouts that it draws.
#[must_use]
pub fn missing_trajectories(results: &Results) -> Vec<String> {
    let mut missing = Vec::new();
    for task in &results.tasks {
        let shown = results.shown_rollouts(task);
        for index in results.shown_methods(task) {
            let method = &results.methods[index];
            let had_joints = |run: &Run| {
                let jerk = run.motion.as_ref().and_then(|motion| motion.joint_jerk);
                run.directory().is_none() && jerk.is_some()
            };
            let is_shown = shown.iter().any(|shown| shown.run.method == *method);
            if !is_shown && results.of(task, method).any(had_joints) {
                missing.push(format!(
                    "joints of {task} · {method}: the earlier report has no rollout"
                ));
            }
        }
    }
    missing
}

fn positions(rollout: &Rollout) -> &[Vec<f64>] {
    &rollout.positions
}

fn velocities(rollout: &Rollout) -> &[Vec<f64>] {
    &rollout.velocities
}

fn panel(
    shown: &ShownRollout<'_>,
    colours: &[RGBColor],
    rows: fn(&Rollout) -> &[Vec<f64>],
) -> Panel {
    let ShownRollout { method_index, run, rollout } = shown;
    let (times, rows) = (rollout.times(), rows(rollout));
    let line = |joint: usize| -> Vec<(f64, f64)> {
        times.iter().copied().zip(rows.iter().map(|row| row[joint])).collect()
    };
    Panel {
        title: format!("{}, seed {}", families::short(&run.method), run.seed),
        colour: colours[*method_index],
        lines: (0..rollout.joints.len()).map(line).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::{FixtureRun, fixture_motion, fixture_results};
    use super::super::run::Source;
    use super::*;

    #[test]
    fn methods_with_a_rollout_of_the_same_episode_have_panels_without_sliding_joints() {
        let run = |method, seed| FixtureRun {
            task: "pusher-v0",
            method,
            seed,
            rows: vec![-40.0],
            ended: true,
        };
        let mut results = fixture_results(&[
            run("DDPG", 2),
            run("DDPG", 1),
            run("SAC", 3),
            run("TD3", 1),
            run("NDP", 1),
        ]);
        for run in results.runs.iter_mut().take(4) {
            run.motion = Some(fixture_motion(3.0, -2.0));
        }
        // TD3's rollout is of another episode, and NDP was never measured.
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
            assert!(!svg.contains(text), "{text} is in the picture");
        }
        assert!(pictures[0].svg.contains("joint position [rad]"));
    }

    #[test]
    fn no_picture_without_motion() {
        let run = FixtureRun {
            task: "pusher-v0",
            method: "SAC",
            seed: 1,
            rows: vec![-40.0],
            ended: true,
        };
        assert!(trajectories(&fixture_results(&[run])).unwrap().is_empty());
    }

    #[test]
    fn missing_rollout_is_replaced_by_another_seed_or_reported() {
        let run = |method, seed| FixtureRun {
            task: "pusher-v0",
            method,
            seed,
            rows: vec![-40.0],
            ended: true,
        };
        let mut results =
            fixture_results(&[run("SAC", 1), run("SAC", 2), run("TD3", 1), run("NDP", 1)]);
        for (index, run) in results.runs.iter_mut().enumerate() {
            let mut motion = fixture_motion(3.0, -2.0);
            if index != 1 {
                motion.rollout = None;
            }
            run.motion = Some(motion);
            run.source = Source::Report("earlier".into());
        }
        // NDP's environment does not report its joints.
        results.runs[3].motion.as_mut().unwrap().joint_jerk = None;
        assert_eq!(
            missing_trajectories(&results),
            ["joints of pusher-v0 · TD3: the earlier report has no rollout"]
        );
        let drawn = [0, 1, 2].map(|index| results.is_shown(&results.runs[index]));
        assert_eq!(drawn, [false, true, false]);
    }
}
