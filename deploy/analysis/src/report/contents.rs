//! The content of a report, which the output modules write.

use super::curves::Curves;
use super::efficiency::EfficiencyRow;
use super::filmstrips::Filmstrip;
use super::layout::Picture;
use super::results::Results;
use super::statements::PaperClaims;
use super::tables::Table;

/// Everything that a report shows.
pub struct Report {
    /// Heading.
    pub title: String,
    /// Command that recreates the report.
    pub command: String,
    /// Creation time (RFC 3339).
    pub made: String,
    /// Git commit of the program, if known.
    pub commit: Option<String>,
    /// The compared runs.
    pub results: Results,
    /// One table per measure.
    pub tables: Vec<Table>,
    /// Sample efficiency: environment steps until a threshold is reached.
    pub efficiency: Vec<EfficiencyRow>,
    /// The paper's statements with their verdicts.
    pub claims: PaperClaims,
    /// Learning curves.
    pub curves: Curves,
    /// Return against smoothness, if asked for.
    pub pareto: Vec<Picture>,
    /// Frames of a rollout.
    pub filmstrips: Vec<Filmstrip>,
    /// Joint trajectories of a rollout.
    pub trajectories: Vec<Picture>,
}
