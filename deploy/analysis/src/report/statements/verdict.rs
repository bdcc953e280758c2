//! Verdicts on statements, and their combination.

use serde::Serialize;

/// Minimum number of seeds of each method of a statement.
pub const SEEDS_MIN: usize = 5;
/// Minimum number of episodes in the last evaluation of each run.
pub const EPISODES_MIN: u64 = 100;

/// The verdict on a statement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// The figures agree, and the intervals do not overlap.
    Held,
    /// The figures disagree, and the intervals do not overlap.
    DidNotHold,
    /// The intervals overlap.
    NoClearDifference,
    /// A method has runs, but fewer than `SEEDS_MIN`.
    TooFewSeeds,
    /// The last evaluation of a run has fewer than `EPISODES_MIN` episodes.
    TooFewEpisodes,
    /// A method has no finished run, its runs are too short, or the measure is unknown.
    NotRun,
    /// The paper's own figures contradict the statement.
    CannotHold,
}

impl Verdict {
    /// All verdicts, in the order in which they are counted.
    pub const ALL: [Self; 7] = [
        Self::Held,
        Self::DidNotHold,
        Self::NoClearDifference,
        Self::TooFewSeeds,
        Self::TooFewEpisodes,
        Self::NotRun,
        Self::CannotHold,
    ];

    /// Returns the verdict as text for reports.
    #[must_use]
    pub fn text(self) -> &'static str {
        match self {
            Self::Held => "held",
            Self::DidNotHold => "did not hold",
            Self::NoClearDifference => "no clear difference",
            Self::TooFewSeeds => "too few seeds",
            Self::TooFewEpisodes => "too few episodes",
            Self::NotRun => "not run",
            Self::CannotHold => "cannot hold",
        }
    }
}

/// A verdict with its evidence.
pub(super) struct Judgement {
    pub(super) verdict: Verdict,
    pub(super) evidence: String,
}

impl Judgement {
    pub(super) fn new(verdict: Verdict, evidence: String) -> Self {
        Self { verdict, evidence }
    }

    /// Combines judgements on conditions that must all hold.
    pub(super) fn all(judgements: impl IntoIterator<Item = Self>) -> Self {
        let judgements: Vec<Self> = judgements.into_iter().collect();
        let evidence: Vec<&str> = judgements.iter().map(|it| it.evidence.as_str()).collect();
        Self::new(all(judgements.iter().map(|it| it.verdict)), evidence.join("; "))
    }
}

/// Combines verdicts on conditions that must all hold. A condition that does not hold takes
/// precedence, then missing data.
pub(super) fn all(verdicts: impl IntoIterator<Item = Verdict>) -> Verdict {
    let verdicts: Vec<Verdict> = verdicts.into_iter().collect();
    let order = [
        Verdict::DidNotHold,
        Verdict::NotRun,
        Verdict::TooFewSeeds,
        Verdict::TooFewEpisodes,
        Verdict::NoClearDifference,
        Verdict::Held,
    ];
    order.into_iter().find(|verdict| verdicts.contains(verdict)).unwrap_or(Verdict::NotRun)
}

/// Returns the verdict on a condition that is clearly met, clearly not met, or neither.
pub(super) fn clear(met: bool, not_met: bool) -> Verdict {
    match (met, not_met) {
        (true, _) => Verdict::Held,
        (false, true) => Verdict::DidNotHold,
        (false, false) => Verdict::NoClearDifference,
    }
}
