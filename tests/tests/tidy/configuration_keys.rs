//! Generates `docs/configuration-keys.md` from the types in `shared/src/config/` and
//! `shared/runtime/src/config/`: each key with its doc comment and its default.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::fs;

use dmprl_shared::config::{
    AlgorithmName, ExperimentConfig, Layers, PRESETS, PolicyKind, TASKS, algorithm_defaults,
    policy_defaults,
};
use dmprl_tests::project_root;
use schemars::schema_for;
use serde_json::Value;
use toml::Table;

/// Longer values would hide the rest of their line.
const VALUE_LETTERS_MAX: usize = 40;
/// Maximum number of values in a line.
const VALUES_MAX: usize = 6;

const PAGE: &str = "docs/configuration-keys.md";
/// Set to generate the page instead of comparing it.
const WRITE: &str = "WRITE_CONFIGURATION_KEYS";

const HEAD: &str = "\
# Every configuration key

<!-- Made from the types of the configuration by the test `tidy`. To generate it again:
     WRITE_CONFIGURATION_KEYS=1 cargo test --release --test tidy -->

Set a key in a file for `--config`, with `--set KEY=VALUE`, or in an environment variable;
[Configuration](configuration.md) describes their precedence. Values that a preset, a kind of
policy, an algorithm or a task sets are listed below the default. An algorithm takes precedence over
a preset, a preset over a kind of policy, and this over a task.
";

#[test]
fn the_page_of_configuration_keys_matches_the_types() {
    let path = project_root().join(PAGE);
    let made = page();
    if std::env::var_os(WRITE).is_some() {
        fs::write(&path, made).unwrap();
        return;
    }
    let written = fs::read_to_string(&path).unwrap_or_default();
    let same = written.lines().zip(made.lines()).take_while(|(a, b)| a == b).count();
    assert!(
        written == made,
        "{PAGE} differs from the types of the configuration at line {}:\n  found    {:?}\n  \
         expected {:?}\ngenerate it again: {WRITE}=1 cargo test --release --test tidy",
        same + 1,
        written.lines().nth(same),
        made.lines().nth(same),
    );
}

/// Returns the page.
fn page() -> String {
    let schema = schema_for!(ExperimentConfig).to_value();
    let defaults = Table::try_from(ExperimentConfig::default()).unwrap();
    let others = others();
    let mut text = HEAD.to_owned();
    let mut last_section = String::new();
    for key in keys_in_order() {
        let (section, name) = key.rsplit_once('.').unwrap();
        let of_section = described(&schema, section);
        if section != last_section {
            let about = meaning(&resolved(&schema, &of_section));
            let level = "#".repeat(section.split('.').count() + 1);
            write!(text, "\n{level} {section}\n\n{about}\n").unwrap();
            section.clone_into(&mut last_section);
        }
        let property = &resolved(&schema, &of_section)["properties"][name];
        let about = meaning(property);
        assert!(!about.is_empty(), "{key} has no comment");
        let value = default_text(&key, &defaults, &others);
        let kind = kind(&schema, property);
        // A list is a block of its own; a sentence follows on the same line.
        let gap = if kind.ends_with('\n') { "\n" } else { " " };
        write!(text, "\n### {key}\n\n{about}\n\n{kind}{gap}{value}\n").unwrap();
    }
    text
}

/// Returns every key, in the order of the types.
fn keys_in_order() -> Vec<String> {
    let text = toml::to_string(&ExperimentConfig::default()).unwrap();
    let known = Layers::new().keys();
    let mut section = String::new();
    let mut keys = Vec::new();
    for line in text.lines() {
        if let Some(name) = line.strip_prefix('[') {
            section = name.trim_end_matches(']').to_owned();
            // A key whose value is a table with names of the user's.
            if known.contains(&section) {
                keys.push(section.clone());
            }
        } else if let Some((name, _)) = line.split_once(" = ") {
            keys.push(format!("{section}.{name}"));
        }
    }
    keys
}

/// Returns the schema of a dotted name.
fn described(schema: &Value, name: &str) -> Value {
    name.split('.').fold(schema.clone(), |at, part| {
        let found = resolved(schema, &at)["properties"][part].clone();
        assert!(!found.is_null(), "the schema has no `{name}`");
        found
    })
}

/// Resolves a reference.
fn resolved(schema: &Value, part: &Value) -> Value {
    match part["$ref"].as_str() {
        Some(path) => schema.pointer(path.trim_start_matches('#')).unwrap().clone(),
        None => part.clone(),
    }
}

/// Returns a comment in one line, with escaped special characters.
fn meaning(part: &Value) -> String {
    let text = part["description"].as_str().unwrap_or_default();
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Describes the values of a property.
fn kind(schema: &Value, property: &Value) -> String {
    let part = resolved(schema, property);
    if let Some(choices) = part["oneOf"].as_array() {
        let line = |choice: &Value| {
            format!("- `{}`: {}\n", choice["const"].as_str().unwrap(), meaning(choice))
        };
        return choices.iter().map(line).collect();
    }
    if let Some(forms) = part["anyOf"].as_array() {
        return forms.iter().map(table_form).collect();
    }
    match part["type"].as_str().unwrap_or_default() {
        "integer" => "A whole number.".into(),
        "number" => "A number.".into(),
        "boolean" => "`true` or `false`.".into(),
        "string" => "A text.".into(),
        "object" => "A table of values of any type.".into(),
        "array" => {
            let items = resolved(schema, &part["items"]);
            let each = kind(schema, &items);
            match items["anyOf"].is_array() {
                true => format!("A list of these:\n\n{each}"),
                false => format!("A list; each entry {}{}", each[..1].to_lowercase(), &each[1..]),
            }
        }
        other => panic!("no words for values of type `{other}`: {part}"),
    }
}

/// Describes one variant of an enum with fields.
fn table_form(form: &Value) -> String {
    let fields = form["properties"].as_object().unwrap();
    let names: Vec<_> = fields.keys().map(|name| format!("{name} = …")).collect();
    let mut text = format!("- `{{ {} }}`: {}\n", names.join(", "), meaning(form));
    for (name, field) in fields {
        writeln!(text, "  - `{name}`: {}", meaning(field)).unwrap();
    }
    text
}

/// Returns the tables that override defaults, with a label each.
fn others() -> Vec<(String, Table)> {
    let mut others = Vec::new();
    for kind in [PolicyKind::Dmp, PolicyKind::Mlp, PolicyKind::Chunk] {
        if let Some(table) = policy_defaults(kind) {
            others.push((format!("with `--policy {}`", name_of(kind)), table));
        }
    }
    for algorithm in AlgorithmName::ALL {
        if let Some(table) = algorithm_defaults(algorithm) {
            others.push((format!("with `--algo {}`", name_of(algorithm)), table));
        }
    }
    for preset in &PRESETS {
        others.push((format!("with `--preset {}`", preset.name), preset.table()));
        for task in &TASKS {
            let label = format!("with `--preset {}` on `{}`", preset.name, task.name);
            others.push((label, task.over_preset(preset.name)));
        }
    }
    others.extend(TASKS.iter().map(|task| (format!("on `{}`", task.name), task.table())));
    others
}

fn name_of(value: impl serde::Serialize) -> String {
    serde_json::to_value(value).unwrap().as_str().unwrap().to_owned()
}

fn at<'a>(table: &'a Table, key: &str) -> Option<&'a toml::Value> {
    let (first, rest) = key.split_once('.')?;
    let inner = table.get(first)?;
    rest.split('.').try_fold(inner, |value, name| value.get(name))
}

/// Returns the default, and the values that presets, policies, algorithms and tasks set.
fn default_text(key: &str, defaults: &Table, others: &[(String, Table)]) -> String {
    let default = at(defaults, key).unwrap().to_string();
    let mut by_value: BTreeMap<String, Vec<&str>> = BTreeMap::new();
    for (label, table) in others {
        if let Some(value) = at(table, key).map(ToString::to_string) {
            by_value.entry(value).or_default().push(label);
        }
    }
    // An entry equal to the default is shown only if a task overrides it.
    let of_tasks = |labels: &Vec<&str>| labels.iter().any(|label| label.starts_with("on "));
    let same = by_value.remove(&default);
    if let Some(labels) = same.filter(|_| by_value.values().any(of_tasks)) {
        by_value.insert(default.clone(), labels);
    }
    if by_value.is_empty() {
        return format!("Default: `{default}`.");
    }
    let long = by_value.keys().any(|value| value.len() > VALUE_LETTERS_MAX);
    if long || by_value.len() >= VALUES_MAX {
        return format!("Default: `{default}`; each of the tasks has its own.");
    }
    let mut text = format!("Default: `{default}`, but\n\n");
    // In the order of the list above.
    let mut rest: Vec<_> = by_value.into_iter().collect();
    rest.sort_by_key(|(_, labels)| others.iter().position(|(label, _)| label == labels[0]));
    for (value, labels) in rest {
        writeln!(text, "- `{value}` {}", joined(&labels)).unwrap();
    }
    text.pop();
    text
}

/// `on a, on b` is `on a, b`.
fn joined(labels: &[&str]) -> String {
    let mut text = String::new();
    let mut last = "";
    for label in labels {
        let (word, name) = label.split_once(' ').unwrap();
        let gap = if text.is_empty() { "" } else { ", " };
        let word = if word == last { String::new() } else { format!("{word} ") };
        write!(text, "{gap}{word}{name}").unwrap();
        last = label.split_once(' ').unwrap().0;
    }
    text
}
