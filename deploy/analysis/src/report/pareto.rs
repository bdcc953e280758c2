//! Draws return against smoothness, a point for each method, with the Pareto front.

use anyhow::anyhow;
use dmprl_run::safe_name;

use super::families;
use super::layout::Picture;
use super::measures::{Measure, MeasureKind};
use super::results::Results;
use super::run::Run;
use super::statistics::Summary;
use crate::plots::{Bounded, Scatter, ScatterPanel, ScatterPoint, palette};

/// Draws a picture for each task with at least two methods of known smoothness. Its panels have the
/// success rate on the vertical axis if the task reports it, else the return.
///
/// # Errors
/// A picture cannot be drawn.
pub fn pareto(results: &Results) -> anyhow::Result<Vec<Picture>> {
    let mut pictures = Vec::new();
    for task in &results.tasks {
        let vertical = vertical(results, task);
        let measures = Measure::TABLES.into_iter();
        let panels: Vec<ScatterPanel> = measures
            .filter(|measure| measure.kind() == MeasureKind::Smoothness)
            .map(|measure| panel(results, task, measure, vertical))
            .filter(|panel| panel.points.len() > 1)
            .collect();
        if panels.is_empty() {
            continue;
        }
        let title = format!("{task}: {} and smoothness", vertical.title().to_lowercase());
        let names = families::names(&results.methods);
        let colours = palette(&names);
        let scatter = Scatter {
            title: &title,
            y_label: vertical.title(),
            legend: names.into_iter().zip(colours).collect(),
            panels,
        };
        let svg =
            scatter.draw().map_err(|error| anyhow!("cannot draw the front of {task}: {error}"))?;
        pictures.push(Picture { path: format!("pareto/{}", safe_name(task)), alt: title, svg });
    }
    Ok(pictures)
}

/// Returns the measure on the vertical axis of a task's panels.
fn vertical(results: &Results, task: &str) -> Measure {
    let has_success = results
        .runs
        .iter()
        .any(|run| run.task == *task && run.last().is_some_and(|row| row.success_rate.is_some()));
    if has_success { Measure::Success } else { Measure::Return }
}

/// Returns the indices of the methods that no other beats in both, `measure` and the result, in the
/// order of the report. There are none if fewer than two methods have a point.
pub(super) fn unbeaten(results: &Results, task: &str, measure: Measure) -> Vec<usize> {
    let points = points(results, task, measure, vertical(results, task));
    if points.len() < 2 {
        return Vec::new();
    }
    let front = front_of(&points, measure);
    let unbeaten = points.iter().filter(|point| front.contains(&point.place()));
    unbeaten.map(|point| point.method_index).collect()
}

/// The point of a method.
struct MethodPoint {
    method_index: usize,
    x: Bounded,
    y: Bounded,
}

impl MethodPoint {
    fn place(&self) -> (f64, f64) {
        (self.x.value, self.y.value)
    }
}

/// Returns the points of the methods that have a run of which both measures are known.
fn points(results: &Results, task: &str, measure: Measure, vertical: Measure) -> Vec<MethodPoint> {
    let point = |(method_index, method): (usize, &String)| {
        let values = |run: &Run| Some((measure.of(run)?, vertical.of(run)?));
        let (x, y): (Vec<_>, Vec<_>) = results.of(task, method).filter_map(values).unzip();
        Some(MethodPoint { method_index, x: Summary::of(&x)?.into(), y: Summary::of(&y)?.into() })
    };
    results.methods.iter().enumerate().filter_map(point).collect()
}

fn front_of(points: &[MethodPoint], measure: Measure) -> Vec<(f64, f64)> {
    front(points.iter().map(MethodPoint::place).collect(), measure.higher_is_better())
}

/// Returns the panel of a measure.
fn panel(results: &Results, task: &str, measure: Measure, vertical: Measure) -> ScatterPanel {
    let points = points(results, task, measure, vertical);
    let names = families::names(&results.methods);
    let colours = palette(&names);
    let drawn = points.iter().map(|&MethodPoint { method_index, x, y }| {
        let (name, values) = families::split(&results.methods[method_index]);
        let method = names.iter().position(|other| *other == name).unwrap_or(0);
        let values: Vec<_> = values.into_iter().map(|(_, value)| value).collect();
        ScatterPoint { method, colour: colours[method], label: values.join(", "), x, y }
    });
    ScatterPanel {
        x_label: measure.title().trim_start_matches("Smoothness: ").to_owned(),
        points: drawn.collect(),
        front: front_of(&points, measure),
    }
}

impl From<Summary> for Bounded {
    fn from(summary: Summary) -> Self {
        let (value, bounds) = summary.point_and_bounds();
        Self { value, bounds }
    }
}

/// Returns the points (x, y) that no other point beats in x and y, from the smallest x on. More y
/// is better; more or less x, by `more_x_is_better`.
fn front(mut points: Vec<(f64, f64)>, more_x_is_better: bool) -> Vec<(f64, f64)> {
    let x_loss = |point: &(f64, f64)| if more_x_is_better { -point.0 } else { point.0 };
    points.sort_by(|a, b| x_loss(a).total_cmp(&x_loss(b)).then(b.1.total_cmp(&a.1)));
    let mut best = f64::NEG_INFINITY;
    points.retain(|point| {
        let is_better = point.1 > best;
        best = best.max(point.1);
        is_better
    });
    if more_x_is_better {
        points.reverse();
    }
    points
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::{FixtureRun, fixture_motion, fixture_results};
    use super::*;

    #[test]
    fn front_has_the_points_that_no_other_beats() {
        let points = vec![(3.0, 5.0), (1.0, 1.0), (2.0, 0.5), (2.0, 4.0), (4.0, 5.0), (1.0, 0.0)];
        assert_eq!(front(points.clone(), false), [(1.0, 1.0), (2.0, 4.0), (3.0, 5.0)]);
        assert_eq!(front(points, true), [(4.0, 5.0)]);
        assert_eq!(front(vec![(-2.0, 3.0), (-1.0, 1.0)], true), [(-2.0, 3.0), (-1.0, 1.0)]);
    }

    #[test]
    fn methods_of_a_grid_share_a_colour_and_show_their_values() {
        let run = |method, reward| FixtureRun {
            task: "pusher-v0",
            method,
            seed: 1,
            rows: vec![reward],
            ended: true,
        };
        let results = fixture_results(&[
            run("TD3, algorithm.action_rate_penalty=0.25", -40.0),
            run("SAC, algorithm.action_rate_penalty=0.25", -45.0),
            run("TD3, algorithm.action_rate_penalty=0.75", -30.0),
        ]);
        let panel = panel(&results, "pusher-v0", Measure::ActionChange, Measure::Return);
        let labels: Vec<_> = panel.points.iter().map(|point| point.label.as_str()).collect();
        assert_eq!(labels, ["0.25", "0.25", "0.75"]);
        let of_method = |index: usize| (panel.points[index].method, panel.points[index].colour);
        assert_eq!(of_method(0), of_method(2));
        assert!(of_method(0).0 != of_method(1).0 && of_method(0).1 != of_method(1).1);
        let svg = &pareto(&results).unwrap()[0].svg;
        assert_eq!((svg.matches("TD3").count(), svg.matches("0.75").count()), (1, 1));
    }

    #[test]
    fn a_task_with_two_measured_methods_has_a_picture_and_others_have_none() {
        let run = |task, method, reward| FixtureRun {
            task,
            method,
            seed: 1,
            rows: vec![reward],
            ended: true,
        };
        let mut results = fixture_results(&[
            run("pusher-v0", "DDPG", -40.0),
            run("pusher-v0", "SAC", -30.0),
            run("reacher-v1", "SAC", -5.0),
        ]);
        for (run, jerk) in results.runs.iter_mut().zip([3.0, 9.0, 9.0]) {
            run.motion = Some(fixture_motion(jerk, -2.0));
        }
        let pictures = pareto(&results).unwrap();
        let paths: Vec<_> = pictures.iter().map(|picture| picture.path.as_str()).collect();
        assert_eq!(paths, ["pareto/pusher-v0"]);
        for text in ["Average return", "joint jerk", "SPARC", "change of actions", "DDPG"] {
            assert!(pictures[0].svg.contains(text), "{text} is missing");
        }
    }
}
