//! States the finding of each table and figure in a sentence, from its numbers.

use dmprl_run::format::grouped;

use super::efficiency::EfficiencyRow;
use super::filmstrips::{Filmstrip, first_run};
use super::measures::{Measure, MeasureKind};
use super::pareto::unbeaten;
use super::results::Results;
use super::tables::{Cell, Table};

/// Maximum number of methods that a sentence names.
const NAMES_MAX: usize = 4;

/// Methods, and the tasks of which the same is true.
struct Group {
    methods: Vec<String>,
    tasks: Vec<String>,
}

/// Adds a task to the group with the same methods.
fn add(groups: &mut Vec<Group>, methods: Vec<String>, task: String) {
    match groups.iter_mut().find(|group| group.methods == methods) {
        Some(group) => group.tasks.push(task),
        None => groups.push(Group { methods, tasks: vec![task] }),
    }
}

/// Returns `start: A on x and y; B and C on z.`, or `None` without a group.
fn sentence(start: &str, groups: &[Group]) -> Option<String> {
    let text = |group: &Group| format!("{} on {}", listed(&group.methods), listed(&group.tasks));
    let groups: Vec<_> = groups.iter().map(text).collect();
    (!groups.is_empty()).then(|| format!("{start}: {}.", groups.join("; ")))
}

/// Names those of `methods` for which `is_named` is true, or counts them if they are many.
fn named(methods: &[String], is_named: impl Fn(usize) -> bool) -> Vec<String> {
    let quoted = |name: &String| {
        // A comma in a name looks like the end of the name.
        if name.contains(',') { format!("\"{name}\"") } else { name.clone() }
    };
    let named = methods.iter().enumerate().filter(|(index, _)| is_named(*index));
    let names: Vec<String> = named.map(|(_, name)| quoted(name)).collect();
    match names.len() {
        count if count > 1 && count == methods.len() => vec!["all methods".to_owned()],
        count if count > NAMES_MAX => vec![format!("{count} of {} methods", methods.len())],
        _ => names,
    }
}

/// Joins as in a sentence: `a, b and c`.
fn listed(words: &[String]) -> String {
    match words {
        [] => String::new(),
        [one] => one.clone(),
        [first @ .., last] => format!("{} and {last}", first.join(", ")),
    }
}

/// Names the methods with the best mean of each task, and the tasks where the bounds of the best
/// overlap with no other's. Returns `None` for a measure of cost.
pub fn best(table: &Table, methods: &[String]) -> Option<String> {
    let start = match table.measure.kind() {
        MeasureKind::Result => "Highest mean",
        MeasureKind::Smoothness => "Smoothest",
        MeasureKind::Cost => return None,
    };
    let (mut groups, mut apart, mut has_bounds) = (Vec::new(), Vec::new(), false);
    for (task, cells) in &table.rows {
        let is_best = table.best(cells);
        let names = named(methods, |index| is_best[index]);
        if names.is_empty() {
            continue;
        }
        add(&mut groups, names, task.clone());
        has_bounds |= cells.iter().flat_map(|cell| &cell.summary).all(|it| it.count > 1);
        if is_apart(cells, &is_best) {
            apart.push(task.clone());
        }
    }
    let text = sentence(start, &groups)?;
    Some(match apart.as_slice() {
        [] if !has_bounds => text,
        [] => format!("{text} Everywhere the bounds of the best overlap with another's."),
        tasks => {
            format!("{text} The bounds of the best overlap with no other's on {}.", listed(tasks))
        }
    })
}

/// Returns true if one cell is the best and its bounds overlap with no other's.
fn is_apart(cells: &[Cell], is_best: &[bool]) -> bool {
    let bounds = |of_best: bool| {
        let cells = cells.iter().zip(is_best).filter(move |(_, is_best)| **is_best == of_best);
        cells.filter_map(|(cell, _)| cell.summary.as_ref())
    };
    let mut best = bounds(true);
    let (Some(first), None) = (best.next(), best.next()) else { return false };
    let [low, high] = first.point_and_bounds().1;
    first.count > 1
        && bounds(false).all(|other| {
            let [other_low, other_high] = other.point_and_bounds().1;
            other.count > 1 && (high < other_low || other_high < low)
        })
}

/// Names the methods that reach the threshold of each task first, if there are several methods.
pub fn first_to_threshold(rows: &[EfficiencyRow], methods: &[String]) -> Option<String> {
    if methods.len() < 2 {
        return None;
    }
    let mut groups = Vec::new();
    for row in rows {
        let medians = row.cells.iter().filter_map(|cell| cell.median);
        let Some(first) = medians.min_by(f64::total_cmp) else { continue };
        let names = named(methods, |index| row.cells[index].median == Some(first));
        let steps = grouped(first.round() as u64);
        add(&mut groups, names, format!("{} ({}, {steps} steps)", row.task, row.threshold));
    }
    sentence("First to the threshold, by the median over seeds", &groups)
}

/// Names the methods that no other beats in both result and smoothness.
pub fn front(results: &Results) -> Option<String> {
    let mut groups = Vec::new();
    for task in &results.tasks {
        let unbeaten = unbeaten(results, task, Measure::ActionChange);
        let names = named(&results.methods, |index| unbeaten.contains(&index));
        if !names.is_empty() {
            add(&mut groups, names, task.clone());
        }
    }
    sentence("No other method beats these in both result and mean change of actions", &groups)
}

/// States the last evaluations of the policies that the filmstrips show.
pub fn frames(results: &Results, filmstrips: &[Filmstrip]) -> Option<String> {
    let text = |Filmstrip { task, method, .. }: &Filmstrip| {
        let last = first_run(results, task, method)?.last()?;
        Some(match last.success_rate {
            Some(rate) => format!("{method} success {rate:.2}"),
            None => format!("{method} {:.1}", last.return_mean),
        })
    };
    let of_task = |filmstrips: &[Filmstrip]| {
        let texts: Vec<String> = filmstrips.iter().filter_map(text).collect();
        (!texts.is_empty()).then(|| format!("{} {}", filmstrips[0].task, texts.join(", ")))
    };
    let tasks = filmstrips.chunk_by(Filmstrip::is_of_same_task);
    let texts: Vec<String> = tasks.filter_map(of_task).collect();
    let start = "Last evaluations of the shown policies";
    (!texts.is_empty()).then(|| format!("{start}: {}.", texts.join("; ")))
}

/// Names the method with the lowest joint jerk among those whose joints are shown.
pub fn joints(results: &Results) -> Option<String> {
    let mut groups = Vec::new();
    for task in &results.tasks {
        let shown = results.shown_rollouts(task);
        let mut jerks: Vec<_> = shown
            .iter()
            .filter_map(|shown| Some((shown.run.motion.as_ref()?.joint_jerk?, shown)))
            .collect();
        jerks.sort_by(|a, b| a.0.total_cmp(&b.0));
        if let [(jerk, lowest), _, ..] = jerks.as_slice() {
            let task = format!("{task} ({jerk:.0} {}/s³)", lowest.rollout.unit);
            add(&mut groups, named(&results.methods, |index| index == lowest.method_index), task);
        }
    }
    sentence("Lowest joint jerk of the shown runs", &groups)
}

#[cfg(test)]
mod tests {
    use super::super::efficiency::efficiency;
    use super::super::fixtures::{FixtureRun, fixture_motion, fixture_results};
    use super::super::tables::tables;
    use super::*;

    fn results() -> Results {
        let run = |task, method, seed, value: f64| FixtureRun {
            task,
            method,
            seed,
            rows: vec![value - 1.0, value],
            ended: true,
        };
        fixture_results(&[
            run("reacher-v1", "DDPG", 1, -9.0),
            run("reacher-v1", "DDPG", 2, -9.5),
            run("reacher-v1", "SAC", 1, -5.0),
            run("reacher-v1", "SAC", 2, -6.0),
            run("pusher-v0", "DDPG", 1, -40.0),
            run("pusher-v0", "DDPG", 2, -50.0),
            run("pusher-v0", "SAC", 1, -39.5),
            run("pusher-v0", "SAC", 2, -48.0),
        ])
    }

    #[test]
    fn best_methods_are_named_with_the_tasks_where_they_are_apart() {
        let results = results();
        let of = |results: &Results| best(&tables(results)[0], &results.methods);
        assert_eq!(
            of(&results).unwrap(),
            "Highest mean: SAC on reacher-v1 and pusher-v0. The bounds of the best overlap with no \
             other's on reacher-v1."
        );
        let mut one_seed = results.clone();
        one_seed.runs.retain(|run| run.seed == 1);
        assert_eq!(of(&one_seed).unwrap(), "Highest mean: SAC on reacher-v1 and pusher-v0.");
        one_seed.runs.retain(|run| run.method == "SAC");
        assert_eq!(of(&one_seed), None, "there is nothing to compare");
    }

    #[test]
    fn names_with_commas_are_quoted_and_many_methods_are_counted() {
        let methods = ["DMP", "DMP, last action", "MLP"].map(str::to_owned);
        assert_eq!(listed(&named(&methods, |index| index < 2)), "DMP and \"DMP, last action\"");
        assert_eq!(named(&methods, |_| true), ["all methods"]);
        let many: Vec<String> = (0..6).map(|index| index.to_string()).collect();
        assert_eq!(named(&many, |index| index < 5), ["5 of 6 methods"]);
    }

    #[test]
    fn first_methods_are_named_with_their_steps() {
        let results = results();
        assert_eq!(
            first_to_threshold(&efficiency(&results), &results.methods).unwrap(),
            "First to the threshold, by the median over seeds: SAC on reacher-v1 (return ≥ -10, \
             1,000 steps)."
        );
    }

    #[test]
    fn front_frames_and_joints_name_methods() {
        let mut results = results();
        for (run, jerk) in results.runs.iter_mut().zip([3.0, 3.0, 2.0, 2.0, 1.0, 1.0]) {
            run.motion = Some(fixture_motion(jerk, -2.0));
        }
        assert_eq!(
            joints(&results).unwrap(),
            "Lowest joint jerk of the shown runs: SAC on reacher-v1 (2 rad/s³)."
        );
        assert_eq!(
            front(&results).unwrap(),
            "No other method beats these in both result and mean change of actions: SAC on \
             reacher-v1 and pusher-v0."
        );
        let filmstrip = Filmstrip {
            task: "pusher-v0".to_owned(),
            method: "DDPG".to_owned(),
            path: String::new(),
            alt: String::new(),
            png: Vec::new(),
            base64: String::new(),
        };
        assert_eq!(
            frames(&results, &[filmstrip]).unwrap(),
            "Last evaluations of the shown policies: pusher-v0 DDPG -40.0."
        );
        assert_eq!(frames(&results, &[]), None);
    }
}
