//! A list of violations, as sentences that start with the invariant's name.

/// Maximum number of stored violations. One fault can cause thousands.
const STORED_MAX: usize = 50;

/// A bounded list of violations.
#[derive(Debug, Clone, Default)]
pub(super) struct Violations {
    stored: Vec<String>,
    omitted: u64,
}

impl Violations {
    /// Adds a violation.
    pub(super) fn add(&mut self, violation: String) {
        if self.stored.len() < STORED_MAX {
            self.stored.push(violation);
        } else {
            self.omitted += 1;
        }
    }

    /// Adds several violations.
    pub(super) fn extend(&mut self, others: impl IntoIterator<Item = String>) {
        others.into_iter().for_each(|violation| self.add(violation));
    }

    /// Returns true if there are no violations.
    pub(super) fn is_empty(&self) -> bool {
        self.stored.is_empty()
    }

    /// Returns the number of violations, including those not stored.
    pub(super) fn count(&self) -> u64 {
        self.stored.len() as u64 + self.omitted
    }

    /// Returns all stored violations, and a sentence with the number of the others.
    pub(super) fn into_sentences(self) -> Vec<String> {
        let mut sentences = self.stored;
        if self.omitted > 0 {
            sentences.push(format!("and {} more", self.omitted));
        }
        sentences
    }
}
