//! Tests the verdicts with synthetic results.

use super::*;
use crate::report::fixtures::{FixtureRun, fixture_motion, fixture_results};

/// Returns runs with seeds 1, 2, … and the given evaluations. Of three runs, the first and the last
/// are used twice, because a verdict requires five seeds.
fn seeds<R: AsRef<[f64]>>(task: &'static str, method: &'static str, rows: &[R]) -> Vec<FixtureRun> {
    let rows: Vec<&R> = match rows {
        [first, middle, last] => vec![first, first, middle, last, last],
        rows => rows.iter().collect(),
    };
    let run = |(seed, rows): (u64, &R)| FixtureRun {
        task,
        method,
        seed,
        rows: rows.as_ref().to_vec(),
        ended: true,
    };
    (1..).zip(rows).map(run).collect()
}

fn together(methods: Vec<Vec<FixtureRun>>) -> Results {
    fixture_results(&methods.concat())
}

/// Returns the findings on a statement.
fn found(results: &Results, id: &str) -> Vec<Finding> {
    let claims = evaluate_statements(results).unwrap().results;
    let claim = claims.into_iter().find(|claim| claim.id == id);
    claim.unwrap_or_else(|| panic!("no statement {id:?}")).findings
}

fn verdict(results: &Results, id: &str) -> Verdict {
    let found = found(results, id);
    assert_eq!(found.len(), 1, "{found:?}");
    found[0].verdict
}

const REACHER: &str = "reacher-v1";
const PUSHER: &str = "pusher-v0";
const THROWER: &str = "thrower-v0";
const PANDA: &str = "panda-reach";
const JOINTS: &str = "panda-reach-joints";
const OURS: &str = "DDPG-DMP (paper)";

#[test]
fn intervals_decide_whether_a_difference_is_clear() {
    let id = "pusher-better-return";
    let with = |ddpg: [f64; 3], ndp: [f64; 3]| {
        let rows = |values: [f64; 3]| values.map(|value| vec![value]);
        let of = |method, values: [f64; 3]| {
            let rows = rows(values);
            seeds(PUSHER, method, &[&rows[0], &rows[1], &rows[2]])
        };
        let results =
            together(vec![of(OURS, [-33.0, -34.0, -35.0]), of("DDPG", ddpg), of("NDP", ndp)]);
        verdict(&results, id)
    };
    let worse = [-44.0, -45.0, -46.0];
    assert_eq!(with(worse, worse), Verdict::Held);
    assert_eq!(with(worse, [-20.0, -21.0, -22.0]), Verdict::DidNotHold);
    assert_eq!(with(worse, [-34.5, -36.0, -37.0]), Verdict::NoClearDifference);
}

#[test]
fn missing_data_is_reported() {
    let id = "pusher-better-return";
    let ours = seeds(PUSHER, OURS, &[&[-33.0], &[-34.0], &[-35.0]]);
    let ddpg = seeds(PUSHER, "DDPG", &[&[-44.0], &[-45.0], &[-46.0]]);
    let one = seeds(PUSHER, "NDP", &[&[-60.0]]);
    let without = evaluate_statements(&together(vec![ours.clone(), ddpg.clone()])).unwrap();
    assert!(without.results.iter().all(|claim| claim.task == PUSHER && claim.id != id));
    assert_eq!(without.results.len() + without.left_out, 34, "NDP has no run");
    let few = together(vec![ours.clone(), ddpg.clone(), one.clone()]);
    assert_eq!(verdict(&few, id), Verdict::TooFewSeeds);
    let mut unfinished = one;
    unfinished[0].ended = false;
    let found = found(&together(vec![ours, ddpg, unfinished]), id);
    assert_eq!(found[0].verdict, Verdict::NotRun);
    assert!(found[0].evidence.ends_with("NDP: not finished"), "{}", found[0].evidence);
}

#[test]
fn three_seeds_or_twenty_episodes_are_too_few() {
    let id = "pusher-better-return";
    let mut results = together(vec![
        seeds(PUSHER, OURS, &[&[-33.0], &[-34.0], &[-35.0]]),
        seeds(PUSHER, "DDPG", &[&[-44.0], &[-45.0], &[-46.0]]),
        seeds(PUSHER, "NDP", &[&[-44.0], &[-45.0], &[-46.0]]),
    ]);
    assert_eq!(verdict(&results, id), Verdict::Held);
    let of_ours = results.runs[0].clone();
    for episodes in [Some(20), None] {
        results.runs[0].final_episodes = episodes;
        assert_eq!(verdict(&results, id), Verdict::TooFewEpisodes);
    }
    results.runs[0] = of_ours;
    results.runs.retain(|run| run.seed <= 3);
    let found = found(&results, id).remove(0);
    assert_eq!(found.verdict, Verdict::TooFewSeeds);
    assert!(found.evidence.contains("range ["), "{}", found.evidence);
}

#[test]
fn both_versions_of_the_papers_method_are_evaluated() {
    let results = together(vec![
        seeds(PUSHER, OURS, &[&[-50.0], &[-51.0], &[-52.0]]),
        seeds(PUSHER, "DDPG-DMP", &[&[-30.0], &[-31.0], &[-32.0]]),
        seeds(PUSHER, "DDPG", &[&[-44.0], &[-45.0], &[-46.0]]),
        seeds(PUSHER, "NDP", &[&[-44.0], &[-45.0], &[-46.0]]),
    ]);
    let findings = found(&results, "pusher-better-return");
    let verdicts: Vec<_> = findings.iter().map(|it| (it.subject.unwrap(), it.verdict)).collect();
    let expected = [("DDPG-DMP (paper)", Verdict::DidNotHold), ("DDPG-DMP", Verdict::Held)];
    assert_eq!(verdicts, expected);
    let counted = counts(&evaluate_statements(&results).unwrap().results, "DDPG-DMP");
    let of = |verdict| counted.iter().find(|it| it.0 == verdict).map_or(0, |it| it.1);
    assert_eq!(counted.iter().map(|it| it.1).sum::<usize>(), 4);
    // The statement about reaching -40 within 30,000 steps holds, too.
    assert_eq!((of(Verdict::Held), of(Verdict::CannotHold)), (2, 1), "{counted:?}");
}

#[test]
fn statement_that_the_papers_figures_contradict_cannot_hold() {
    let results = together(vec![
        seeds(REACHER, OURS, &[&[-3.0], &[-3.1], &[-3.2]]),
        seeds(REACHER, "DDPG", &[&[-6.0], &[-6.1], &[-6.2]]),
        seeds(REACHER, "TD3", &[&[-6.0], &[-6.1], &[-6.2]]),
        seeds(REACHER, "SAC", &[&[-6.0], &[-6.1], &[-6.2]]),
        seeds(REACHER, "NDP", &[&[-15.0], &[-16.0], &[-17.0]]),
    ]);
    let findings = found(&results, "reacher-best-return");
    assert_eq!(findings[0].verdict, Verdict::CannotHold);
    assert!(findings[0].evidence.contains("DDPG-DMP (paper) -3.10"), "{}", findings[0].evidence);
    assert_eq!(verdict(&results, "reacher-similar-returns"), Verdict::DidNotHold);
    assert_eq!(verdict(&results, "reacher-better-by-percent"), Verdict::Held);
}

#[test]
fn alike_holds_without_a_clear_difference() {
    let of = |method, values: [f64; 3]| {
        let rows = values.map(|value| [value]);
        seeds(REACHER, method, &[&rows[0], &rows[1], &rows[2]])
    };
    let results = together(vec![
        of(OURS, [-6.0, -7.0, -8.0]),
        of("DDPG", [-6.5, -7.0, -7.5]),
        of("TD3", [-6.1, -7.2, -8.1]),
        of("SAC", [-5.9, -6.8, -7.9]),
    ]);
    assert_eq!(verdict(&results, "reacher-similar-returns"), Verdict::Held);
}

#[test]
fn percentages_need_the_whole_interval() {
    let id = "reacher-better-by-percent";
    let with = |ours: [f64; 3]| {
        let rows = ours.map(|value| [value]);
        let ours = seeds(REACHER, OURS, &[&rows[0], &rows[1], &rows[2]]);
        let ndp = seeds(REACHER, "NDP", &[&[-10.0], &[-10.0], &[-10.0]]);
        verdict(&together(vec![ours, ndp]), id)
    };
    assert_eq!(with([-4.0, -4.1, -4.2]), Verdict::Held);
    assert_eq!(with([-4.0, -4.5, -5.0]), Verdict::NoClearDifference);
    assert_eq!(with([-5.0, -5.5, -6.0]), Verdict::DidNotHold);
}

#[test]
fn seed_that_never_reaches_the_threshold_counts_as_the_slowest() {
    let id = "thrower-sooner-than-ndp";
    let with = |ours: &[&[f64]], ndp: &[&[f64]]| {
        let results = together(vec![seeds(THROWER, OURS, ours), seeds(THROWER, "NDP", ndp)]);
        found(&results, id).remove(0)
    };
    let first: &[f64] = &[-70.0, -70.0, -70.0, -70.0];
    let fourth: &[f64] = &[-90.0, -90.0, -90.0, -70.0];
    let third: &[f64] = &[-90.0, -90.0, -70.0, -70.0];
    let never: &[f64] = &[-90.0, -90.0, -90.0, -90.0];
    assert_eq!(with(&[first; 3], &[fourth; 3]).verdict, Verdict::Held);
    assert_eq!(with(&[first; 3], &[third; 3]).verdict, Verdict::NoClearDifference);
    assert_eq!(with(&[third; 3], &[third; 3]).verdict, Verdict::DidNotHold);
    let against = with(&[first; 3], &[never; 3]);
    assert_eq!(against.verdict, Verdict::Held);
    assert!(against.evidence.contains("NDP not reached, 5 seeds"), "{}", against.evidence);
    assert_eq!(with(&[never; 3], &[never; 3]).verdict, Verdict::NoClearDifference);
    assert_eq!(with(&[never; 3], &[fourth; 3]).verdict, Verdict::DidNotHold);
    assert_eq!(with(&[first, first, never], &[fourth; 3]).verdict, Verdict::NoClearDifference);
}

#[test]
fn unfinished_seed_prevents_a_verdict_on_steps() {
    let fast: &[f64] = &[-9.0];
    let mut ours = seeds(REACHER, OURS, &[fast; 4]);
    ours[3].rows = vec![-20.0];
    ours[3].ended = false;
    let ddpg = seeds(REACHER, "DDPG", &[&[-20.0, -9.0]; 3]);
    let results = together(vec![ours, ddpg]);
    let found = found(&results, "reacher-sooner-than-ddpg");
    assert_eq!(found[0].verdict, Verdict::NotRun);
    assert!(found[0].evidence.starts_with("DDPG-DMP (paper): not finished"), "{found:?}");
}

#[test]
fn within_needs_every_seed_and_waits_for_unfinished_ones() {
    let id = "pusher-within-steps";
    let slow = [vec![-60.0; 30], vec![-30.0]].concat();
    let with = |rows: &[&[f64]]| verdict(&together(vec![seeds(PUSHER, OURS, rows)]), id);
    assert_eq!(with(&[&[-60.0, -39.0][..]; 3]), Verdict::Held);
    assert_eq!(with(&[&slow[..]; 3]), Verdict::DidNotHold);
    assert_eq!(with(&[&slow, &[-39.0], &[-39.0]]), Verdict::NoClearDifference);
    assert_eq!(with(&[&slow[..29]; 3]), Verdict::NotRun);
}

#[test]
fn none_within_can_fail_early_but_holds_only_at_the_end() {
    let id = "joints-none-within-steps";
    let with = |td3: Vec<f64>, length: usize| {
        let flat = vec![0.1; length];
        let mut methods: Vec<_> =
            ["DDPG", "SAC", "NDP"].map(|method| seeds(JOINTS, method, &[&flat[..]; 3])).into();
        methods.push(seeds(JOINTS, "TD3", &[&td3[..]; 3]));
        verdict(&together(methods), id)
    };
    assert_eq!(with(vec![0.1; 50], 50), Verdict::Held);
    assert_eq!(with(vec![0.1; 30], 30), Verdict::NotRun, "the runs end too early");
    assert_eq!(with(vec![0.1, 0.9], 50), Verdict::DidNotHold);
    assert_eq!(
        with([vec![0.1; 50], vec![0.9]].concat(), 50),
        Verdict::Held,
        "a success after the limit does not count"
    );
}

#[test]
fn failure_and_success_are_bounds_on_the_rate() {
    let flat = |rate: f64| vec![rate; 2];
    let with = |method, rate: f64, id| {
        let rows = flat(rate);
        verdict(&together(vec![seeds(PANDA, method, &[&rows[..]; 3])]), id)
    };
    assert_eq!(with("NDP", 0.0, "panda-ndp-fails"), Verdict::Held);
    assert_eq!(with("NDP", 0.6, "panda-ndp-fails"), Verdict::DidNotHold);
    let spread = seeds(PANDA, "NDP", &[&[0.0], &[0.0], &[0.9]]);
    assert_eq!(verdict(&together(vec![spread]), "panda-ndp-fails"), Verdict::NoClearDifference);
    let all = |rate: f64| {
        let rows = flat(rate);
        let of = |method| seeds(PANDA, method, &[&rows[..]; 3]);
        let results = together(vec![of(OURS), of("TD3"), of("SAC")]);
        verdict(&results, "panda-almost-always")
    };
    assert_eq!((all(1.0), all(0.5)), (Verdict::Held, Verdict::DidNotHold));
    // The statement is about 200,000 steps. Runs of 2,000 can refute but not confirm it.
    let short = |rate: f64| {
        let rows = flat(rate);
        let results = together(vec![seeds(JOINTS, "DDPG", &[&rows[..]; 3])]);
        verdict(&results, "joints-ddpg-fails")
    };
    assert_eq!((short(0.0), short(0.8)), (Verdict::NotRun, Verdict::DidNotHold));
}

#[test]
fn lack_of_improvement_and_loss_are_found_in_the_curve() {
    let id = "thrower-ddpg-unimproved";
    let with = |rows: &[&[f64]]| verdict(&together(vec![seeds(THROWER, "DDPG", rows)]), id);
    assert_eq!(with(&[&[-180.0, -181.0], &[-180.0, -170.0], &[-180.0, -183.0]]), Verdict::Held);
    assert_eq!(with(&[&[-180.0, -90.0][..]; 3]), Verdict::DidNotHold);
    let falls = |end: f64| {
        let rows = [vec![-200.0], vec![-80.0; 6], vec![end; 5]].concat();
        let of = |method| seeds(THROWER, method, &[&rows[..]; 3]);
        let results = together(vec![of("TD3"), of("SAC")]);
        verdict(&results, "thrower-td3-and-sac-fall")
    };
    assert_eq!((falls(-110.0), falls(-80.0)), (Verdict::Held, Verdict::DidNotHold));
}

#[test]
fn fewer_updates_and_smaller_changes_of_actions_are_better() {
    let mut results = together(vec![
        seeds(REACHER, OURS, &[&[-7.0]; 3]),
        seeds(REACHER, "DDPG", &[&[-7.0]; 3]),
        seeds(REACHER, "TD3", &[&[-7.0]; 3]),
        seeds(REACHER, "SAC", &[&[-7.0]; 3]),
        seeds(PUSHER, OURS, &[&[-33.0]; 3]),
        seeds(PUSHER, "DDPG", &[&[-44.0]; 3]),
    ]);
    for run in results.runs.iter_mut().filter(|run| run.method == OURS) {
        run.rows[0].updates /= 5;
        run.rows[0].smoothness *= 2.0;
    }
    assert_eq!(verdict(&results, "reacher-fewer-updates"), Verdict::Held);
    let id = "pusher-smoother";
    assert_eq!(verdict(&results, id), Verdict::DidNotHold);
}

#[test]
fn smoother_needs_every_measure() {
    let id = "pusher-smoother";
    let mut results =
        together(vec![seeds(PUSHER, OURS, &[&[-33.0]; 3]), seeds(PUSHER, "DDPG", &[&[-44.0]; 3])]);
    let unmeasured = found(&results, id).remove(0);
    assert_eq!(unmeasured.verdict, Verdict::NotRun);
    assert!(unmeasured.evidence.contains("DDPG: not measured"), "{}", unmeasured.evidence);
    for run in &mut results.runs {
        let ours = run.method == OURS;
        run.rows[0].smoothness = if ours { 0.1 } else { 0.3 };
        run.motion =
            Some(if ours { fixture_motion(5.0, -1.7) } else { fixture_motion(50.0, -3.0) });
    }
    assert_eq!(verdict(&results, id), Verdict::Held);
    for run in results.runs.iter_mut().filter(|run| run.method == OURS) {
        run.motion = Some(fixture_motion(50.0, -1.7));
    }
    assert_eq!(verdict(&results, id), Verdict::NoClearDifference);
}

#[test]
fn tasks_that_are_not_the_papers_have_no_statements() {
    let results = together(vec![seeds("reacher", OURS, &[&[-3.0]; 3])]);
    assert!(evaluate_statements(&results).unwrap().results.is_empty());
}
