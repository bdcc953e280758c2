//! Violations, as sentences that begin with the invariant's name.

/// Maximum number of stored sentences; one fault can cause thousands.
const KEPT_MAX: usize = 50;

/// A bounded list of violations.
#[derive(Debug, Clone, Default)]
pub(super) struct Violations {
    kept: Vec<String>,
    more: u64,
}

impl Violations {
    /// Adds a violation.
    pub(super) fn add(&mut self, violation: String) {
        if self.kept.len() < KEPT_MAX {
            self.kept.push(violation);
        } else {
            self.more += 1;
        }
    }

    /// Adds the violations of another list.
    pub(super) fn extend(&mut self, others: impl IntoIterator<Item = String>) {
        others.into_iter().for_each(|violation| self.add(violation));
    }

    /// Returns true if there are no violations.
    pub(super) fn is_empty(&self) -> bool {
        self.kept.is_empty()
    }

    /// Number of violations, including those not stored.
    pub(super) fn count(&self) -> u64 {
        self.kept.len() as u64 + self.more
    }

    /// All stored sentences, and one with the number of the others.
    pub(super) fn into_sentences(self) -> Vec<String> {
        let mut sentences = self.kept;
        if self.more > 0 {
            sentences.push(format!("and {} more", self.more));
        }
        sentences
    }
}
