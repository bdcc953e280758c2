//! The paper's statements about its results, as rules.

use super::PROPOSED;
use crate::report::measures::Measure;

/// One of them.
#[derive(Debug, Clone, Copy)]
pub(super) struct Statement {
    /// Of the paper.
    pub(super) place: &'static str,
    /// In our words.
    pub(super) claim: &'static str,
    /// On which it is made.
    pub(super) task: &'static str,
    /// How it is judged.
    pub(super) rule: Rule,
}

/// Methods, by the names of `deploy/experiments/paper.toml`, or [`PROPOSED`].
pub(super) type Methods = &'static [&'static str];

/// What has to be so. `method` is better, sooner and so on than each of `than`.
#[derive(Debug, Clone, Copy)]
pub(super) enum Rule {
    /// Better in each of `measures`.
    Better { measures: &'static [Measure], method: &'static str, than: Methods },
    /// Of a higher return by at least so much of the other's [%].
    BetterBy { method: &'static str, than: &'static [(&'static str, f64)] },
    /// No two of them clearly differ.
    Alike { measure: Measure, methods: Methods },
    /// At the threshold in at most this share of the other's steps; `steps`: what the paper says
    /// of both, where it does.
    Sooner { method: &'static str, than: Methods, share: f64, steps: Option<(f64, f64)> },
    /// At the threshold within so many steps.
    Within { method: &'static str, steps: u64 },
    /// None succeeds in more than this share of the episodes within so many steps.
    NoneWithin { methods: Methods, success: f64, steps: u64 },
    /// Ends at a success rate of at least this.
    Succeeds { methods: Methods, success: f64 },
    /// Ends at a success rate of at most this, after at least so many steps.
    Fails { method: &'static str, success: f64, steps: u64 },
    /// Ends no better than its first evaluation was.
    Unimproved { methods: Methods },
    /// Ends below its best by more than this share of what it had won, after so many steps.
    Falls { methods: Methods, share: f64, steps: u64 },
    /// The paper's spread over the seeds is one that success rates can have.
    Spread { method: &'static str },
}

impl Rule {
    /// Whether the paper's method is part of it.
    pub(super) fn is_of_proposed(&self) -> bool {
        match self {
            Self::Better { method, .. }
            | Self::BetterBy { method, .. }
            | Self::Sooner { method, .. }
            | Self::Within { method, .. }
            | Self::Fails { method, .. }
            | Self::Spread { method } => *method == PROPOSED || self.is_against_proposed(),
            Self::Alike { methods, .. }
            | Self::NoneWithin { methods, .. }
            | Self::Succeeds { methods, .. }
            | Self::Unimproved { methods }
            | Self::Falls { methods, .. } => methods.contains(&PROPOSED),
        }
    }

    fn is_against_proposed(&self) -> bool {
        match self {
            Self::Better { than, .. } | Self::Sooner { than, .. } => than.contains(&PROPOSED),
            _ => false,
        }
    }
}

const REACHER: &str = "reacher-v1";
const PUSHER: &str = "pusher-v0";
const THROWER: &str = "thrower-v0";
const PANDA: &str = "panda-reach";
const JOINTS: &str = "panda-reach-joints";
const RETURN: &[Measure] = &[Measure::Return];
const SUCCESS: &[Measure] = &[Measure::Success];
const SMOOTH: &[Measure] = &[Measure::ActionChange, Measure::JointJerk, Measure::Sparc];
const OTHERS: Methods = &["DDPG", "TD3", "SAC", "NDP"];
const PLAIN: Methods = &["DDPG", "TD3", "SAC"];
/// A success rate that counts as failure.
pub const NONE: f64 = 0.05;
/// One that counts as "almost 100 %".
pub const ALMOST_ALL: f64 = 0.95;
/// More often than not.
const MOSTLY: f64 = 0.5;
/// Of what was won; less is noise.
pub const LOSS: f64 = 0.1;

const fn statement(
    place: &'static str,
    task: &'static str,
    claim: &'static str,
    rule: Rule,
) -> Statement {
    Statement { place, claim, task, rule }
}

/// In the paper's order.
pub(super) const STATEMENTS: [Statement; 34] = [
    statement(
        "section 4.2, Table 3",
        REACHER,
        "DDPG-DMP performs best: its return is the highest at the end",
        Rule::Better { measures: RETURN, method: PROPOSED, than: OTHERS },
    ),
    statement(
        "section 4.2, Figure 3",
        REACHER,
        "DDPG, TD3, SAC and DDPG-DMP end at similar returns",
        Rule::Alike { measure: Measure::Return, methods: &[PROPOSED, "DDPG", "TD3", "SAC"] },
    ),
    statement(
        "section 4.2",
        REACHER,
        "DDPG-DMP comes to -10 sooner than DDPG",
        Rule::Sooner { method: PROPOSED, than: &["DDPG"], share: 1.0, steps: None },
    ),
    statement(
        "section 4.2",
        REACHER,
        "DDPG-DMP needs 11.7 % fewer steps to -10 than DDPG (26,000 and 33,000)",
        Rule::Sooner {
            method: PROPOSED,
            than: &["DDPG"],
            share: 0.883,
            steps: Some((26_000.0, 33_000.0)),
        },
    ),
    statement(
        "section 4.2",
        REACHER,
        "SAC needs more steps to -10 than DDPG-DMP",
        Rule::Sooner { method: PROPOSED, than: &["SAC"], share: 1.0, steps: None },
    ),
    statement(
        "section 4.2",
        REACHER,
        "Only TD3 learns as fast as DDPG-DMP",
        Rule::Alike { measure: Measure::StepsToThreshold, methods: &[PROPOSED, "TD3"] },
    ),
    statement(
        "section 4.2",
        REACHER,
        "DDPG-DMP updates less often than DDPG, TD3 and SAC: once a segment",
        Rule::Better { measures: &[Measure::UpdateRate], method: PROPOSED, than: PLAIN },
    ),
    statement(
        "section 4.2, Figure 3",
        REACHER,
        "NDP's learning curve shows no improvement",
        Rule::Unimproved { methods: &["NDP"] },
    ),
    statement(
        "section 4.2",
        REACHER,
        "DDPG-DMP's return is 52.7 % better than NDP's",
        Rule::BetterBy { method: PROPOSED, than: &[("NDP", 52.7)] },
    ),
    statement(
        "section 4.2, Table 3",
        PUSHER,
        "DDPG-DMP performs best: its return is the highest at the end",
        Rule::Better { measures: RETURN, method: PROPOSED, than: OTHERS },
    ),
    statement(
        "section 4.2",
        PUSHER,
        "DDPG-DMP ends at a higher return than DDPG and NDP",
        Rule::Better { measures: RETURN, method: PROPOSED, than: &["DDPG", "NDP"] },
    ),
    statement(
        "section 4.2",
        PUSHER,
        "DDPG-DMP's return is 43.7 % better than DDPG's and 26.7 % better than NDP's",
        Rule::BetterBy { method: PROPOSED, than: &[("DDPG", 43.7), ("NDP", 26.7)] },
    ),
    statement(
        "section 4.2",
        PUSHER,
        "DDPG-DMP learns fastest of all",
        Rule::Sooner { method: PROPOSED, than: OTHERS, share: 1.0, steps: None },
    ),
    statement(
        "section 4.2",
        PUSHER,
        "DDPG-DMP comes above -40 within 30,000 steps",
        Rule::Within { method: PROPOSED, steps: 30_000 },
    ),
    statement(
        "section 4.2, Table 3",
        THROWER,
        "DDPG-DMP performs best: its return is the highest at the end",
        Rule::Better { measures: RETURN, method: PROPOSED, than: OTHERS },
    ),
    statement(
        "section 4.2",
        THROWER,
        "DDPG learns nothing",
        Rule::Unimproved { methods: &["DDPG"] },
    ),
    statement(
        "section 4.2",
        THROWER,
        "TD3 and SAC lose again what they have learnt",
        Rule::Falls { methods: &["TD3", "SAC"], share: LOSS, steps: 0 },
    ),
    statement(
        "section 4.2",
        THROWER,
        "NDP ends at a higher return than DDPG, TD3 and SAC",
        Rule::Better { measures: RETURN, method: "NDP", than: PLAIN },
    ),
    statement(
        "section 4.2",
        THROWER,
        "DDPG-DMP's return is better by 65.1 % than DDPG's, 43.8 % than TD3's, 34.2 % than SAC's \
         and 16.2 % than NDP's",
        Rule::BetterBy {
            method: PROPOSED,
            than: &[("DDPG", 65.1), ("TD3", 43.8), ("SAC", 34.2), ("NDP", 16.2)],
        },
    ),
    statement(
        "section 4.2",
        THROWER,
        "DDPG-DMP comes to NDP's return in a third of NDP's steps",
        Rule::Sooner { method: PROPOSED, than: &["NDP"], share: 1.0 / 3.0, steps: None },
    ),
    statement(
        "section 4.3, Table 4",
        PANDA,
        "DDPG ends at a lower success rate than DDPG-DMP",
        Rule::Better { measures: SUCCESS, method: PROPOSED, than: &["DDPG"] },
    ),
    statement(
        "section 4.3, Table 4",
        PANDA,
        "DDPG-DMP, TD3 and SAC succeed almost always",
        Rule::Succeeds { methods: &[PROPOSED, "TD3", "SAC"], success: ALMOST_ALL },
    ),
    statement(
        "section 4.3",
        PANDA,
        "NDP fails",
        Rule::Fails { method: "NDP", success: NONE, steps: 0 },
    ),
    statement(
        "section 4.3",
        PANDA,
        "SAC learns faster than DDPG-DMP",
        Rule::Sooner { method: "SAC", than: &[PROPOSED], share: 1.0, steps: None },
    ),
    statement(
        "section 4.3",
        PANDA,
        "DDPG-DMP learns faster than TD3 and DDPG",
        Rule::Sooner { method: PROPOSED, than: &["TD3", "DDPG"], share: 1.0, steps: None },
    ),
    statement(
        "section 4.3",
        JOINTS,
        "None of the compared methods succeeds more often than not within 50,000 steps",
        Rule::NoneWithin { methods: OTHERS, success: MOSTLY, steps: 50_000 },
    ),
    statement(
        "section 4.3",
        JOINTS,
        "DDPG fails, even after 200,000 steps",
        Rule::Fails { method: "DDPG", success: NONE, steps: 200_000 },
    ),
    statement(
        "section 4.3, Table 4",
        JOINTS,
        "SAC's success rate is 0.85 ± 0.41 over five seeds",
        Rule::Spread { method: "SAC" },
    ),
    statement(
        "section 4.3",
        JOINTS,
        "SAC becomes unstable after 120,000 steps",
        Rule::Falls { methods: &["SAC"], share: LOSS, steps: 120_000 },
    ),
    statement(
        "section 4.3",
        JOINTS,
        "NDP fails",
        Rule::Fails { method: "NDP", success: NONE, steps: 0 },
    ),
    statement(
        "section 4.3, Table 4",
        JOINTS,
        "DDPG-DMP succeeds almost always",
        Rule::Succeeds { methods: &[PROPOSED], success: ALMOST_ALL },
    ),
    statement(
        "section 4.3",
        JOINTS,
        "DDPG-DMP learns faster than every other",
        Rule::Sooner { method: PROPOSED, than: OTHERS, share: 1.0, steps: None },
    ),
    statement(
        "section 4.4, Figures 5, 6",
        PUSHER,
        "DDPG-DMP moves more smoothly than DDPG",
        Rule::Better { measures: SMOOTH, method: PROPOSED, than: &["DDPG"] },
    ),
    statement(
        "section 4.4, Figure 7",
        JOINTS,
        "DDPG-DMP moves more smoothly than TD3 and SAC",
        Rule::Better { measures: SMOOTH, method: PROPOSED, than: &["TD3", "SAC"] },
    ),
];
