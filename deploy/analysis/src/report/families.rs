//! Groups the methods of a sweep's grid: their labels differ in `key=value` pairs at the end.

/// Splits the label of a method, such as `TD3-DMP, exploration.std=0.2`, into the method's name and
/// the keys with their values.
pub(super) fn split(label: &str) -> (&str, Vec<(&str, &str)>) {
    let (mut name, mut values) = (label, Vec::new());
    while let Some((before, last)) = name.rsplit_once(", ") {
        let Some(pair) = last.split_once('=') else { break };
        values.insert(0, pair);
        name = before;
    }
    (name, values)
}

/// Returns the names of the methods, each once, in order.
pub(super) fn names(labels: &[String]) -> Vec<&str> {
    let mut names: Vec<&str> = Vec::new();
    for name in labels.iter().map(|label| split(label).0) {
        if !names.contains(&name) {
            names.push(name);
        }
    }
    names
}

/// Returns the keys of the grid, each once, in order.
pub(super) fn keys(labels: &[String]) -> Vec<&str> {
    let mut keys: Vec<&str> = Vec::new();
    for (key, _) in labels.iter().flat_map(|label| split(label).1) {
        if !keys.contains(&key) {
            keys.push(key);
        }
    }
    keys
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
    }

    #[test]
    fn names_and_keys_are_listed_once() {
        let labels = ["A, x=1", "A, x=2", "B, x=1, y=3", "C"].map(str::to_owned);
        assert_eq!(names(&labels), ["A", "B", "C"]);
        assert_eq!(keys(&labels), ["x", "y"]);
    }
}
