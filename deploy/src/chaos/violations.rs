//! What did not hold, in sentences that begin with the invariant's name.

/// So many are kept word for word; one fault often brings thousands.
const KEPT_MAX: usize = 50;

/// A bounded list of sentences.
#[derive(Debug, Clone, Default)]
pub(super) struct Violations {
    kept: Vec<String>,
    more: u64,
}

impl Violations {
    /// Adds one.
    pub(super) fn add(&mut self, violation: String) {
        if self.kept.len() < KEPT_MAX {
            self.kept.push(violation);
        } else {
            self.more += 1;
        }
    }

    /// Adds those of another list.
    pub(super) fn extend(&mut self, others: impl IntoIterator<Item = String>) {
        others.into_iter().for_each(|violation| self.add(violation));
    }

    /// Whether everything held.
    pub(super) fn is_empty(&self) -> bool {
        self.kept.is_empty()
    }

    /// How many there are.
    pub(super) fn count(&self) -> u64 {
        self.kept.len() as u64 + self.more
    }

    /// All sentences, and one about those that are not kept.
    pub(super) fn into_sentences(self) -> Vec<String> {
        let mut sentences = self.kept;
        if self.more > 0 {
            sentences.push(format!("and {} more", self.more));
        }
        sentences
    }
}
