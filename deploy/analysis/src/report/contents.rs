//! The contents of a report.

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
    /// Command that makes the report again.
    pub command: String,
    /// Time at which it was made (RFC 3339).
    pub made: String,
    /// Git commit of the program, if it is known.
    pub commit: Option<String>,
    /// The runs.
    pub results: Results,
    /// Tables of measures.
    pub tables: Vec<Table>,
    /// Environment steps until a threshold is reached.
    pub efficiency: Vec<EfficiencyRow>,
    /// The paper's statements with their verdicts.
    pub claims: PaperClaims,
    /// Learning curves.
    pub curves: Vec<Picture>,
    /// Frames of a rollout.
    pub filmstrips: Vec<Filmstrip>,
    /// Joints over a rollout.
    pub trajectories: Vec<Picture>,
}
