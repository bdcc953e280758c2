//! Each verdict, by planted results.

use super::*;
use crate::report::fixtures::{FixtureRun, fixture_motion, fixture_results};

/// Seeds 1, 2, ... of a method, each with its evaluations. Three rows stand for the five seeds that
/// a verdict needs: the first and the last are planted twice.
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

/// The findings of the one statement whose claim begins so.
fn found(results: &Results, task: &str, claim: &str) -> Vec<Finding> {
    let claims = evaluate_statements(results).unwrap().results;
    let mut of_task =
        claims.into_iter().filter(|it| it.task == task && it.claim.starts_with(claim));
    let found = of_task.next().unwrap_or_else(|| panic!("no statement {claim:?} on {task}"));
    assert!(of_task.next().is_none(), "{claim:?} is more than one statement");
    found.findings
}

fn verdict(results: &Results, task: &str, claim: &str) -> Verdict {
    let found = found(results, task, claim);
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
fn a_difference_holds_fails_or_is_unclear_by_its_intervals() {
    let claim = "DDPG-DMP ends at a higher return than DDPG and NDP";
    let with = |ddpg: [f64; 3], ndp: [f64; 3]| {
        let rows = |values: [f64; 3]| values.map(|value| vec![value]);
        let of = |method, values: [f64; 3]| {
            let rows = rows(values);
            seeds(PUSHER, method, &[&rows[0], &rows[1], &rows[2]])
        };
        let results =
            together(vec![of(OURS, [-33.0, -34.0, -35.0]), of("DDPG", ddpg), of("NDP", ndp)]);
        verdict(&results, PUSHER, claim)
    };
    let worse = [-44.0, -45.0, -46.0];
    assert_eq!(with(worse, worse), Verdict::Held);
    assert_eq!(with(worse, [-20.0, -21.0, -22.0]), Verdict::DidNotHold);
    assert_eq!(with(worse, [-34.5, -36.0, -37.0]), Verdict::NoClearDifference);
}

#[test]
fn what_is_missing_is_said_and_never_guessed() {
    let claim = "DDPG-DMP ends at a higher return than DDPG and NDP";
    let ours = seeds(PUSHER, OURS, &[&[-33.0], &[-34.0], &[-35.0]]);
    let ddpg = seeds(PUSHER, "DDPG", &[&[-44.0], &[-45.0], &[-46.0]]);
    let one = seeds(PUSHER, "NDP", &[&[-60.0]]);
    let without = found(&together(vec![ours.clone(), ddpg.clone()]), PUSHER, claim);
    assert_eq!(without[0].verdict, Verdict::NotRun);
    assert!(without[0].evidence.ends_with("NDP: not run"), "{}", without[0].evidence);
    let few = together(vec![ours.clone(), ddpg.clone(), one.clone()]);
    assert_eq!(verdict(&few, PUSHER, claim), Verdict::TooFewSeeds);
    let mut under_way = one;
    under_way[0].ended = false;
    let found = found(&together(vec![ours, ddpg, under_way]), PUSHER, claim);
    assert_eq!(found[0].verdict, Verdict::NotRun);
    assert!(found[0].evidence.ends_with("NDP: not finished"), "{}", found[0].evidence);
}

#[test]
fn nothing_is_judged_by_three_seeds_or_by_twenty_episodes() {
    let claim = "DDPG-DMP ends at a higher return than DDPG and NDP";
    let mut results = together(vec![
        seeds(PUSHER, OURS, &[&[-33.0], &[-34.0], &[-35.0]]),
        seeds(PUSHER, "DDPG", &[&[-44.0], &[-45.0], &[-46.0]]),
        seeds(PUSHER, "NDP", &[&[-44.0], &[-45.0], &[-46.0]]),
    ]);
    assert_eq!(verdict(&results, PUSHER, claim), Verdict::Held);
    let of_ours = results.runs[0].clone();
    for episodes in [Some(20), None] {
        results.runs[0].final_episodes = episodes;
        assert_eq!(verdict(&results, PUSHER, claim), Verdict::TooFewEpisodes);
    }
    results.runs[0] = of_ours;
    results.runs.retain(|run| run.seed <= 3);
    let found = found(&results, PUSHER, claim).remove(0);
    assert_eq!(found.verdict, Verdict::TooFewSeeds);
    assert!(found.evidence.contains("range ["), "{}", found.evidence);
}

#[test]
fn our_method_is_held_to_the_same_statements_beside_the_papers() {
    let results = together(vec![
        seeds(PUSHER, OURS, &[&[-50.0], &[-51.0], &[-52.0]]),
        seeds(PUSHER, "DDPG-DMP", &[&[-30.0], &[-31.0], &[-32.0]]),
        seeds(PUSHER, "DDPG", &[&[-44.0], &[-45.0], &[-46.0]]),
        seeds(PUSHER, "NDP", &[&[-44.0], &[-45.0], &[-46.0]]),
    ]);
    let findings = found(&results, PUSHER, "DDPG-DMP ends at a higher return than DDPG and NDP");
    let verdicts: Vec<_> = findings.iter().map(|it| (it.subject.unwrap(), it.verdict)).collect();
    let expected = [("DDPG-DMP (paper)", Verdict::DidNotHold), ("DDPG-DMP", Verdict::Held)];
    assert_eq!(verdicts, expected);
    let counted = counts(&evaluate_statements(&results).unwrap().results, "DDPG-DMP");
    let of = |verdict| counted.iter().find(|it| it.0 == verdict).map_or(0, |it| it.1);
    assert_eq!(counted.iter().map(|it| it.1).sum::<usize>(), 34);
    // It comes above -40 in time, too.
    assert_eq!((of(Verdict::Held), of(Verdict::CannotHold)), (2, 5), "{counted:?}");
}

#[test]
fn what_the_paper_contradicts_cannot_hold_whatever_the_runs_show() {
    let results = together(vec![
        seeds(REACHER, OURS, &[&[-3.0], &[-3.1], &[-3.2]]),
        seeds(REACHER, "DDPG", &[&[-6.0], &[-6.1], &[-6.2]]),
        seeds(REACHER, "TD3", &[&[-6.0], &[-6.1], &[-6.2]]),
        seeds(REACHER, "SAC", &[&[-6.0], &[-6.1], &[-6.2]]),
        seeds(REACHER, "NDP", &[&[-15.0], &[-16.0], &[-17.0]]),
    ]);
    let findings = found(&results, REACHER, "DDPG-DMP performs best");
    assert_eq!(findings[0].verdict, Verdict::CannotHold);
    assert!(findings[0].evidence.contains("DDPG-DMP (paper) -3.10"), "{}", findings[0].evidence);
    assert_eq!(verdict(&results, REACHER, "DDPG, TD3, SAC and"), Verdict::DidNotHold);
    assert_eq!(verdict(&results, REACHER, "DDPG-DMP's return is 52.7 %"), Verdict::Held);
}

#[test]
fn alike_holds_where_no_difference_is_clear() {
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
    assert_eq!(verdict(&results, REACHER, "DDPG, TD3, SAC and"), Verdict::Held);
}

#[test]
fn percentages_need_the_whole_interval() {
    let claim = "DDPG-DMP's return is 52.7 %";
    let with = |ours: [f64; 3]| {
        let rows = ours.map(|value| [value]);
        let ours = seeds(REACHER, OURS, &[&rows[0], &rows[1], &rows[2]]);
        let ndp = seeds(REACHER, "NDP", &[&[-10.0], &[-10.0], &[-10.0]]);
        verdict(&together(vec![ours, ndp]), REACHER, claim)
    };
    assert_eq!(with([-4.0, -4.1, -4.2]), Verdict::Held);
    assert_eq!(with([-4.0, -4.5, -5.0]), Verdict::NoClearDifference);
    assert_eq!(with([-5.0, -5.5, -6.0]), Verdict::DidNotHold);
}

#[test]
fn sooner_counts_a_seed_that_never_came_as_later_than_all() {
    let claim = "DDPG-DMP comes to NDP's return in a third";
    let with = |ours: &[&[f64]], ndp: &[&[f64]]| {
        let results = together(vec![seeds(THROWER, OURS, ours), seeds(THROWER, "NDP", ndp)]);
        found(&results, THROWER, claim).remove(0)
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
fn a_seed_under_way_that_is_not_there_yet_makes_no_method_look_faster() {
    let fast: &[f64] = &[-9.0];
    let mut ours = seeds(REACHER, OURS, &[fast; 4]);
    ours[3].rows = vec![-20.0];
    ours[3].ended = false;
    let ddpg = seeds(REACHER, "DDPG", &[&[-20.0, -9.0]; 3]);
    let results = together(vec![ours, ddpg]);
    let found = found(&results, REACHER, "DDPG-DMP comes to -10 sooner than DDPG");
    assert_eq!(found[0].verdict, Verdict::NotRun);
    assert!(found[0].evidence.starts_with("DDPG-DMP (paper): not finished"), "{found:?}");
}

#[test]
fn within_so_many_steps_asks_for_every_seed_and_waits_for_those_that_may_yet_come() {
    let claim = "DDPG-DMP comes above -40 within 30,000 steps";
    let slow = [vec![-60.0; 30], vec![-30.0]].concat();
    let with = |rows: &[&[f64]]| verdict(&together(vec![seeds(PUSHER, OURS, rows)]), PUSHER, claim);
    assert_eq!(with(&[&[-60.0, -39.0][..]; 3]), Verdict::Held);
    assert_eq!(with(&[&slow[..]; 3]), Verdict::DidNotHold);
    assert_eq!(with(&[&slow, &[-39.0], &[-39.0]]), Verdict::NoClearDifference);
    assert_eq!(with(&[&slow[..29]; 3]), Verdict::NotRun);
}

#[test]
fn none_within_so_many_steps_is_refuted_early_and_held_only_at_their_end() {
    let claim = "None of the compared methods";
    let with = |td3: Vec<f64>, length: usize| {
        let flat = vec![0.1; length];
        let mut methods: Vec<_> =
            ["DDPG", "SAC", "NDP"].map(|method| seeds(JOINTS, method, &[&flat[..]; 3])).into();
        methods.push(seeds(JOINTS, "TD3", &[&td3[..]; 3]));
        verdict(&together(methods), JOINTS, claim)
    };
    assert_eq!(with(vec![0.1; 50], 50), Verdict::Held);
    assert_eq!(with(vec![0.1; 30], 30), Verdict::NotRun, "the rest was not run");
    assert_eq!(with(vec![0.1, 0.9], 50), Verdict::DidNotHold);
    assert_eq!(with([vec![0.1; 50], vec![0.9]].concat(), 50), Verdict::Held, "later is later");
}

#[test]
fn failing_and_succeeding_are_bounds_on_the_rate() {
    let flat = |rate: f64| vec![rate; 2];
    let with = |method, rate: f64, claim| {
        let rows = flat(rate);
        verdict(&together(vec![seeds(PANDA, method, &[&rows[..]; 3])]), PANDA, claim)
    };
    assert_eq!(with("NDP", 0.0, "NDP fails"), Verdict::Held);
    assert_eq!(with("NDP", 0.6, "NDP fails"), Verdict::DidNotHold);
    let spread = seeds(PANDA, "NDP", &[&[0.0], &[0.0], &[0.9]]);
    assert_eq!(verdict(&together(vec![spread]), PANDA, "NDP fails"), Verdict::NoClearDifference);
    let all = |rate: f64| {
        let rows = flat(rate);
        let of = |method| seeds(PANDA, method, &[&rows[..]; 3]);
        let results = together(vec![of(OURS), of("TD3"), of("SAC")]);
        verdict(&results, PANDA, "DDPG-DMP, TD3 and SAC succeed")
    };
    assert_eq!((all(1.0), all(0.5)), (Verdict::Held, Verdict::DidNotHold));
    // Said of 200,000 steps: 2,000 can refute it and not confirm it.
    let short = |rate: f64| {
        let rows = flat(rate);
        let results = together(vec![seeds(JOINTS, "DDPG", &[&rows[..]; 3])]);
        verdict(&results, JOINTS, "DDPG fails")
    };
    assert_eq!((short(0.0), short(0.8)), (Verdict::NotRun, Verdict::DidNotHold));
}

#[test]
fn learning_nothing_and_losing_it_again_are_read_from_the_curve() {
    let nothing = "DDPG learns nothing";
    let with =
        |rows: &[&[f64]]| verdict(&together(vec![seeds(THROWER, "DDPG", rows)]), THROWER, nothing);
    assert_eq!(with(&[&[-180.0, -181.0], &[-180.0, -170.0], &[-180.0, -183.0]]), Verdict::Held);
    assert_eq!(with(&[&[-180.0, -90.0][..]; 3]), Verdict::DidNotHold);
    let falls = |end: f64| {
        let rows = [vec![-200.0], vec![-80.0; 6], vec![end; 5]].concat();
        let of = |method| seeds(THROWER, method, &[&rows[..]; 3]);
        let results = together(vec![of("TD3"), of("SAC")]);
        verdict(&results, THROWER, "TD3 and SAC lose again")
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
    assert_eq!(verdict(&results, REACHER, "DDPG-DMP updates less often"), Verdict::Held);
    let smoothly = "DDPG-DMP moves more smoothly than DDPG";
    assert_eq!(verdict(&results, PUSHER, smoothly), Verdict::DidNotHold);
}

#[test]
fn motion_is_smoother_only_by_every_measure() {
    let claim = "DDPG-DMP moves more smoothly than DDPG";
    let mut results =
        together(vec![seeds(PUSHER, OURS, &[&[-33.0]; 3]), seeds(PUSHER, "DDPG", &[&[-44.0]; 3])]);
    let unmeasured = found(&results, PUSHER, claim).remove(0);
    assert_eq!(unmeasured.verdict, Verdict::NotRun);
    assert!(unmeasured.evidence.contains("DDPG: not measured"), "{}", unmeasured.evidence);
    for run in &mut results.runs {
        let ours = run.method == OURS;
        run.rows[0].smoothness = if ours { 0.1 } else { 0.3 };
        run.motion =
            Some(if ours { fixture_motion(5.0, -1.7) } else { fixture_motion(50.0, -3.0) });
    }
    assert_eq!(verdict(&results, PUSHER, claim), Verdict::Held);
    for run in results.runs.iter_mut().filter(|run| run.method == OURS) {
        run.motion = Some(fixture_motion(50.0, -1.7));
    }
    assert_eq!(verdict(&results, PUSHER, claim), Verdict::NoClearDifference);
}

#[test]
fn runs_of_other_tasks_are_not_held_to_the_paper() {
    let results = together(vec![seeds("reacher", OURS, &[&[-3.0]; 3])]);
    assert!(evaluate_statements(&results).unwrap().results.is_empty());
}
