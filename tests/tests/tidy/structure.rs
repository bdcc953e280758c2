//! Which crate may use which, and which modules may use each other.
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

use dmprl_tests::project_root;

/// Maximum number of files of one folder that use each other in a circle.
const CIRCLE_MAX: usize = 3;

/// The crates of the program and the other crates of the workspace that each uses, from the
/// highest to the lowest. A crate may only use those below it.
const CRATES: [(&str, &[&str]); 15] = [
    ("deploy/extension", &["actors"]),
    (
        "deploy/cli",
        &[
            "actors",
            "analysis",
            "bench",
            "bridge",
            "chaos",
            "control",
            "dashboard",
            "learner",
            "run",
            "shared",
            "supervisor",
            "sweep",
        ],
    ),
    (
        "deploy/bench",
        &[
            "actors",
            "analysis",
            "bridge",
            "control",
            "learner",
            "run",
            "runtime",
            "shared",
            "supervisor",
        ],
    ),
    ("deploy/chaos", &["learner", "run", "shared", "supervisor"]),
    ("deploy/sweep", &["analysis", "run", "shared", "supervisor"]),
    ("deploy/dashboard", &["analysis", "run", "shared"]),
    ("deploy/analysis", &["run", "shared"]),
    ("deploy/supervisor", &["actors", "control", "run", "shared"]),
    ("deploy/bridge", &["control", "run", "shared"]),
    ("deploy/control", &["run", "shared"]),
    ("deploy/run", &["shared"]),
    ("actors", &["shared"]),
    ("learner", &["shared"]),
    ("shared", &["runtime"]),
    ("shared/runtime", &[]),
];

#[test]
fn each_crate_uses_only_crates_below_it() {
    for (at, (path, expected)) in CRATES.iter().enumerate() {
        let manifest = project_root().join(path).join("Cargo.toml");
        let manifest: toml::Table = fs::read_to_string(manifest).unwrap().parse().unwrap();
        let dependencies = manifest["dependencies"].as_table().unwrap();
        let used: Vec<&str> =
            dependencies.keys().filter_map(|name| name.strip_prefix("dmprl-")).collect();
        assert_eq!(used, *expected, "{path}/Cargo.toml: dependencies within the workspace");
        for name in used {
            let place = CRATES.iter().position(|(path, _)| path.rsplit('/').next() == Some(name));
            assert!(place.unwrap() > at, "{path} uses {name}, which is above it");
        }
    }
}

/// The lock file also lists optional dependencies that another member of the workspace turns on, so
/// a program next to a robot gets these packages or fewer.
#[test]
fn a_program_next_to_a_robot_gets_nothing_that_only_a_training_needs() {
    let read = |path: &str| -> toml::Table {
        fs::read_to_string(project_root().join(path)).unwrap().parse().unwrap()
    };
    let manifest = read("shared/runtime/Cargo.toml");
    assert!(!manifest["features"].as_table().unwrap().contains_key("default"));
    let is_optional = |dependency: &toml::Value| {
        dependency.get("optional").and_then(toml::Value::as_bool).unwrap_or(false)
    };
    let lock = read("Cargo.lock");
    let mut found = BTreeSet::new();
    let dependencies = manifest["dependencies"].as_table().unwrap().iter();
    let mut open: Vec<&str> = dependencies
        .filter(|(_, dependency)| !is_optional(dependency))
        .map(|(name, _)| name.as_str())
        .collect();
    while let Some(name) = open.pop() {
        if !found.insert(name) {
            continue;
        }
        for package in lock["package"].as_array().unwrap() {
            if package["name"].as_str() == Some(name)
                && let Some(dependencies) = package.get("dependencies")
            {
                let names = dependencies.as_array().unwrap().iter();
                // A version follows the name if there are several.
                open.extend(names.filter_map(|name| name.as_str()?.split(' ').next()));
            }
        }
    }
    assert!(found.contains("gemm-common"), "{found:?}");
    for name in ["iceoryx2", "schemars", "tokio", "toml", "zenoh"] {
        assert!(!found.contains(name), "dmprl-runtime depends on {name}");
    }
}

#[test]
fn modules_do_not_use_each_other_in_circles() {
    let mut circles = Vec::new();
    for (path, _) in CRATES {
        let modules = Modules::read(&project_root().join(path).join("src"));
        for circle in modules.circles() {
            if !modules.share_a_folder(&circle) || circle.len() > CIRCLE_MAX {
                circles.push(format!("{path}: {}", circle.join(", ")));
            }
        }
    }
    assert!(
        circles.is_empty(),
        "modules in a circle cannot be read apart:\n{}",
        circles.join("\n")
    );
}

/// The modules of a crate with the modules that each one names.
struct Modules(BTreeMap<String, BTreeSet<String>>);

impl Modules {
    fn read(src: &Path) -> Self {
        let mut texts = BTreeMap::new();
        collect(src, "", &mut texts);
        let uses = |(name, text): (&String, &String)| {
            let mut used: BTreeSet<String> =
                paths(name, text).iter().filter_map(|path| nearest(&texts, path)).collect();
            used.remove(name);
            (name.clone(), used)
        };
        Self(texts.iter().map(uses).collect())
    }

    /// Returns true if all modules are in one folder, to which its own file (`mod.rs`) belongs.
    /// Each folder at the crate's root counts separately.
    fn share_a_folder(&self, circle: &[String]) -> bool {
        let parent = |module: &str| module.rsplit_once('/').map(|(folder, _)| folder.to_owned());
        let is_folder = |module: &str| {
            let below = format!("{module}/");
            self.0.keys().any(|other| other.starts_with(&below))
        };
        let first = &circle[0];
        let mut candidates = vec![parent(first)];
        candidates.extend(is_folder(first).then(|| Some(first.clone())));
        candidates.iter().any(|folder| {
            circle.iter().all(|module| match folder {
                Some(folder) => module == folder || parent(module).as_ref() == Some(folder),
                None => parent(module).is_none() && !is_folder(module),
            })
        })
    }

    /// Sets of two or more modules, each of which reaches all the others.
    fn circles(&self) -> Vec<Vec<String>> {
        let reached: BTreeMap<&String, BTreeSet<String>> =
            self.0.keys().map(|module| (module, self.reached(module))).collect();
        let mut circles = BTreeSet::new();
        for module in self.0.keys() {
            let circle: Vec<String> = self
                .0
                .keys()
                .filter(|other| reached[module].contains(*other) && reached[other].contains(module))
                .cloned()
                .collect();
            if circle.len() > 1 {
                circles.insert(circle);
            }
        }
        circles.into_iter().collect()
    }

    fn reached(&self, module: &String) -> BTreeSet<String> {
        let (mut reached, mut open) = (BTreeSet::new(), vec![module]);
        while let Some(module) = open.pop() {
            for used in &self.0[module] {
                if reached.insert(used.clone()) {
                    open.push(used);
                }
            }
        }
        reached
    }
}

/// Reads the code of each module, without comments and tests, by the module's path. The crate's
/// root has the path "".
fn collect(folder: &Path, prefix: &str, texts: &mut BTreeMap<String, String>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_stem().unwrap().to_str().unwrap();
        let module = if prefix.is_empty() { name.to_owned() } else { format!("{prefix}/{name}") };
        if path.is_dir() {
            collect(&path, &module, texts);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            let module = match name {
                "lib" | "main" | "mod" => prefix.to_owned(),
                _ => module,
            };
            let text = fs::read_to_string(&path).unwrap();
            let code = text.split("#[cfg(test)]\nmod tests {").next().unwrap_or_default();
            let lines = code.lines().map(|line| line.split("//").next().unwrap_or_default());
            texts.entry(module).or_default().push_str(&lines.collect::<Vec<_>>().join("\n"));
        }
    }
}

/// Returns every path within the crate that `text` names, as segments below the crate's root.
fn paths(module: &str, text: &str) -> Vec<Vec<String>> {
    let own: Vec<&str> = module.split('/').filter(|part| !part.is_empty()).collect();
    let mut found = Vec::new();
    for (start, keyword) in
        ["crate::", "super::", "self::"].iter().flat_map(|word| text.match_indices(word))
    {
        let before = text[..start].chars().next_back();
        if before.is_some_and(|letter| letter.is_alphanumeric() || letter == '_' || letter == ':') {
            continue;
        }
        let mut base = if keyword == "crate::" { Vec::new() } else { own.clone() };
        let mut rest = &text[start..];
        while let Some(below) = rest.strip_prefix("super::") {
            base.pop();
            rest = below;
        }
        rest = rest.strip_prefix("crate::").or(rest.strip_prefix("self::")).unwrap_or(rest);
        found.extend(items(rest).into_iter().map(|item| {
            base.iter()
                .map(ToString::to_string)
                .chain(item.split("::").map(str::to_owned))
                .collect()
        }));
    }
    found
}

/// Returns the paths at the beginning of `text`: one, or all within its braces.
fn items(text: &str) -> Vec<String> {
    let word = |text: &str| -> String {
        let is_part = |letter: &char| letter.is_alphanumeric() || ['_', ':'].contains(letter);
        text.trim_start().chars().take_while(is_part).collect()
    };
    let head = word(text);
    let Some(list) = text[head.len()..].strip_prefix('{') else { return vec![head] };
    let (mut depth, mut item, mut found) = (0, String::new(), Vec::new());
    for letter in list.chars() {
        match letter {
            '{' => depth += 1,
            '}' if depth == 0 => break,
            '}' => depth -= 1,
            ',' if depth == 0 => found.push(std::mem::take(&mut item)),
            _ => {}
        }
        if depth == 0 && letter != ',' {
            item.push(letter);
        }
    }
    found.push(item);
    // After a comma at the end.
    found.retain(|item| !item.trim().is_empty());
    found.iter().map(|item| format!("{head}{}", word(item))).collect()
}

/// Returns the longest prefix of a path that is a module.
fn nearest(texts: &BTreeMap<String, String>, path: &[String]) -> Option<String> {
    let path: Vec<&str> = path.iter().map(String::as_str).filter(|part| !part.is_empty()).collect();
    (0..=path.len()).rev().map(|len| path[..len].join("/")).find(|path| texts.contains_key(path))
}

#[test]
fn paths_are_found_in_every_form_of_import() {
    let text = "use super::{a, b::C,};\nuse crate::d::e::{self, F};\nfn f() { self::g::h() }";
    let mut found: Vec<String> =
        paths("x/y", text).iter().map(|path| path.join("/").replace("//", "/")).collect();
    found.sort();
    assert_eq!(found, ["d/e/F", "d/e/self", "x/a", "x/b/C", "x/y/g/h"]);
}
