//! Groups the methods of a sweep's grid: their labels differ in `key=value` pairs at the end.

/// Returns the distinct values in order.
pub(super) fn distinct<T: PartialEq>(values: impl IntoIterator<Item = T>) -> Vec<T> {
    let mut known = Vec::new();
    for value in values {
        if !known.contains(&value) {
            known.push(value);
        }
    }
    known
}

/// Splits the label of a method, such as `TD3-DMP, exploration.std=0.2`, into the method's name and
/// the keys with their values.
pub(super) fn split(label: &str) -> (&str, Vec<(&str, &str)>) {
    let starts = label.match_indices(", ").map(|(at, _)| at);
    let starts: Vec<usize> = starts.filter(|at| pair(&label[at + 2..]).is_some()).collect();
    let ends = starts.iter().skip(1).copied().chain([label.len()]);
    let pairs = starts.iter().zip(ends).filter_map(|(at, end)| pair(&label[at + 2..end]));
    (&label[..starts.first().copied().unwrap_or(label.len())], pairs.collect())
}

/// Returns the label of a method with the values of its keys only, such as `TD3-DMP, 0.2`.
pub(super) fn short(label: &str) -> String {
    let (name, values) = split(label);
    let values = values.into_iter().map(|(_, value)| value);
    std::iter::once(name).chain(values).collect::<Vec<_>>().join(", ")
}

/// Splits `key=value`. The value may be a list, and so contain commas.
fn pair(text: &str) -> Option<(&str, &str)> {
    let is_of_key = |letter: char| letter.is_ascii_alphanumeric() || "._-".contains(letter);
    text.split_once('=').filter(|(key, _)| !key.is_empty() && key.chars().all(is_of_key))
}

/// Returns the names of the methods, each once, in order.
pub(super) fn names(labels: &[String]) -> Vec<&str> {
    distinct(labels.iter().map(|label| split(label).0))
}

/// Returns the keys of the grid, each once, in order.
pub(super) fn keys(labels: &[String]) -> Vec<&str> {
    distinct(labels.iter().flat_map(|label| split(label).1).map(|(key, _)| key))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_pairs_at_the_end_are_values() {
        assert_eq!(split("TD3-DMP"), ("TD3-DMP", vec![]));
        assert_eq!(split("DMP, last action"), ("DMP, last action", vec![]));
        assert_eq!(
            split("DMP, last action, algorithm.discount=0.9, run.steps=5"),
            ("DMP, last action", vec![("algorithm.discount", "0.9"), ("run.steps", "5")])
        );
        assert_eq!(
            split("TD3, policy.hidden=[64, 64], run.steps=5"),
            ("TD3", vec![("policy.hidden", "[64, 64]"), ("run.steps", "5")])
        );
        assert_eq!(short("DMP, last action, run.steps=5"), "DMP, last action, 5");
    }

    #[test]
    fn names_and_keys_are_listed_once() {
        let labels = ["A, x=1", "A, x=2", "B, x=1, y=3", "C"].map(str::to_owned);
        assert_eq!(names(&labels), ["A", "B", "C"]);
        assert_eq!(keys(&labels), ["x", "y"]);
    }
}
