//! Stage 1 of 8, on the command line: merges task, preset, file, environment variables and flags
//! into one configuration.

use std::path::Path;

use anyhow::Context;
use dmprl_run::failure::wrong_use;
use dmprl_shared::config::{
    ConfigError, ExperimentConfig, Layers, PRESETS, TASKS, algorithm_defaults, is_python_object,
    nearest, policy_defaults, task_defaults,
};
use toml::{Table, Value};

const PREFIX: &str = "DMPRL_";
/// Size limit of a configuration file, which has a few kilobytes.
const FILE_BYTES_MAX: u64 = 1 << 20;

/// A key that is set by its own flag.
#[derive(Debug)]
pub(super) struct Flag {
    /// The flag as typed, for error messages.
    pub(super) flag: &'static str,
    /// Dotted configuration key.
    pub(super) key: &'static str,
    /// Value to set.
    pub(super) value: Value,
}

/// All sources of a configuration, lowest precedence first.
#[derive(Debug)]
pub(super) struct Sources<'a> {
    pub(super) task: &'a str,
    pub(super) preset: &'a str,
    pub(super) file: Option<&'a Path>,
    /// All environment variables; those without our prefix are ignored.
    pub(super) environment: Vec<(String, String)>,
    /// `key=value` pairs of `--set`, in the order given.
    pub(super) set: &'a [String],
    /// `key=value` pairs of `--env-kwargs`; they override `--set`.
    pub(super) env_kwargs: &'a [String],
    /// Keys set by flags; they override `--set`.
    pub(super) flags: Vec<Flag>,
}

/// Merges the sources. Every mistake in them is a usage error.
///
/// Policy and algorithm are known only after merging. Their own defaults override the preset: if
/// there are any, the sources are merged once more with them.
pub(super) fn merge(sources: &Sources<'_>) -> anyhow::Result<ExperimentConfig> {
    let config = merge_with(&[], sources)?;
    let own: Vec<_> = [
        policy_defaults(config.policy.kind).map(|table| ("policy defaults", table)),
        algorithm_defaults(config.algorithm.name).map(|table| ("algorithm defaults", table)),
    ]
    .into_iter()
    .flatten()
    .collect();
    if own.is_empty() { Ok(config) } else { merge_with(&own, sources) }
}

/// Adds the pairs of `--env-kwargs`.
pub(super) fn add_env_kwargs(layers: &mut Layers, pairs: &[String]) -> anyhow::Result<()> {
    for pair in pairs {
        let (name, text) = pair.split_once('=').ok_or_else(|| {
            wrong_use(format!("--env-kwargs {pair}: expected KEY=VALUE, as in reward_type=dense"))
        })?;
        let key = format!("task.kwargs.{}", name.trim());
        layers.set("--env-kwargs", &key, text.trim()).map_err(refuse)?;
    }
    Ok(())
}

fn merge_with(own: &[(&str, Table)], sources: &Sources<'_>) -> anyhow::Result<ExperimentConfig> {
    let mut layers = Layers::new();
    add(&mut layers, sources.task, task_table(sources.task)?)?;
    let preset = PRESETS.iter().find(|preset| preset.name == sources.preset);
    let preset = preset.with_context(|| format!("no preset {}", sources.preset))?;
    add(&mut layers, preset.name, preset.table())?;
    if let Some(task) = task_defaults(sources.task) {
        add(&mut layers, preset.name, task.over_preset(preset.name))?;
    }
    for (origin, table) in own {
        add(&mut layers, origin, table.clone())?;
    }
    if let Some(file) = sources.file {
        add(&mut layers, &file.display().to_string(), read_table(file)?)?;
    }
    let mut ours: Vec<_> =
        sources.environment.iter().filter(|(name, _)| name.starts_with(PREFIX)).collect();
    ours.sort();
    for (name, text) in ours {
        let key = name[PREFIX.len()..].to_ascii_lowercase().replace("__", ".");
        layers.set(&format!("environment variable {name}"), &key, text).map_err(refuse)?;
    }
    for pair in sources.set {
        let (key, text) = pair.split_once('=').ok_or_else(|| {
            wrong_use(format!("--set {pair}: expected KEY=VALUE, as in algorithm.batch_size=64"))
        })?;
        layers.set("--set", key.trim(), text.trim()).map_err(refuse)?;
    }
    add_env_kwargs(&mut layers, sources.env_kwargs)?;
    for Flag { flag, key, value } in &sources.flags {
        add(&mut layers, flag, nested(key, value.clone()))?;
    }
    let config = layers.finish().map_err(refuse)?;
    if config.task.name != sources.task {
        return Err(wrong_use(format!(
            "the configuration is for task `{}`, but the command line names `{}`; name the same \
             task or remove task.name",
            config.task.name, sources.task
        )));
    }
    Ok(config)
}

/// Turns a `ConfigError` into a usage error.
pub(super) fn refuse(error: ConfigError) -> anyhow::Error {
    wrong_use(error.to_string())
}

fn add(layers: &mut Layers, origin: &str, table: Table) -> anyhow::Result<()> {
    layers.add(origin, table).map_err(refuse)
}

fn task_table(name: &str) -> anyhow::Result<Table> {
    if let Some(task) = task_defaults(name) {
        return Ok(task.table());
    }
    if is_gymnasium_id(name) || is_python_object(name) {
        let mut task = Table::new();
        task.insert("name".into(), name.into());
        task.insert("id".into(), name.into());
        return Ok(Table::from_iter([("task".to_owned(), Value::Table(task))]));
    }
    let near = nearest(&name.to_ascii_lowercase(), TASKS.iter().map(|task| task.name));
    let advice = near.map_or_else(
        || "`dmprl tasks` lists the built-in tasks".to_owned(),
        |near| format!("did you mean `{near}`?"),
    );
    Err(wrong_use(format!(
        "unknown task `{name}`, {advice}\n  A Gymnasium id ends with its version, such as \
         Pendulum-v1 or my_module:MyArm-v0; a class is my_module:MyClass"
    )))
}

/// Matches `[module:][namespace/]Name-vN`.
fn is_gymnasium_id(text: &str) -> bool {
    let (module, id) = text.split_once(':').map_or((None, text), |(module, id)| (Some(module), id));
    let word = |text: &str, also: &str| {
        text.starts_with(|letter: char| letter.is_ascii_alphanumeric() || letter == '_')
            && text.chars().all(|letter| {
                letter.is_ascii_alphanumeric() || letter == '_' || also.contains(letter)
            })
    };
    let (namespace, versioned) =
        id.split_once('/').map_or((None, id), |(namespace, name)| (Some(namespace), name));
    let Some((name, version)) = versioned.rsplit_once("-v") else { return false };
    module.is_none_or(|module| word(module, "."))
        && namespace.is_none_or(|namespace| word(namespace, "-"))
        && word(name, ".-")
        && !version.is_empty()
        && version.chars().all(|letter| letter.is_ascii_digit())
}

fn read_table(path: &Path) -> anyhow::Result<Table> {
    let refused = |what: String| wrong_use(format!("--config {}: {what}", path.display()));
    let metadata = std::fs::metadata(path).map_err(|error| refused(error.to_string()))?;
    if !metadata.is_file() || metadata.len() > FILE_BYTES_MAX {
        return Err(refused(format!("expected a file of at most {FILE_BYTES_MAX} bytes")));
    }
    let text = std::fs::read_to_string(path).map_err(|error| refused(error.to_string()))?;
    text.parse().map_err(|error: toml::de::Error| refused(error.to_string()))
}

fn nested(key: &str, value: Value) -> Table {
    let mut names: Vec<&str> = key.split('.').collect();
    let last = names.pop().unwrap_or_default();
    let leaf = Table::from_iter([(last.to_owned(), value)]);
    names
        .into_iter()
        .rev()
        .fold(leaf, |inner, name| Table::from_iter([(name.to_owned(), Value::Table(inner))]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use dmprl_run::failure::WrongUse;
    use dmprl_shared::config::{Controller, ForcingScaling, Integrator, Limits, Start};
    use std::io::Write;

    fn sources(task: &str) -> Sources<'_> {
        Sources {
            task,
            preset: "default",
            file: None,
            environment: Vec::new(),
            set: &[],
            env_kwargs: &[],
            flags: Vec::new(),
        }
    }

    fn variable(name: &str, value: &str) -> (String, String) {
        (name.to_owned(), value.to_owned())
    }

    fn refused(sources: Sources<'_>) -> String {
        let error = merge(&sources).unwrap_err();
        assert!(error.downcast_ref::<WrongUse>().is_some(), "{error:#}");
        error.to_string()
    }

    /// Adds one source at a time, each with its own value for the same key: the last wins.
    #[test]
    fn each_layer_overrides_the_one_before() {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        writeln!(file, "[run]\nsteps = 3").unwrap();
        let set = ["run.steps=5".to_owned()];
        let mut merged = Vec::new();
        for layers in 0..5 {
            let mut sources = sources("pusher");
            // The preset `paper` does not set run.steps, so it must not change the value.
            sources.preset = if layers >= 1 { "paper" } else { "default" };
            sources.file = (layers >= 1).then_some(file.path());
            sources.environment = vec![variable("HOME", "/root")];
            if layers >= 2 {
                sources.environment.push(variable("DMPRL_RUN__STEPS", "4"));
            }
            sources.set = if layers >= 3 { &set } else { &[] };
            if layers >= 4 {
                let value = Value::Integer(6);
                sources.flags.push(Flag { flag: "--steps", key: "run.steps", value });
            }
            merged.push(merge(&sources).unwrap().run.steps);
        }
        assert_eq!(merged, [200_000, 3, 4, 5, 6]);
    }

    /// Each source sets one argument of its own and one that the later ones set too.
    #[test]
    fn arguments_of_the_environment_come_from_every_source() {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        writeln!(file, "[task.kwargs]\nfile = 1\nlast = 'file'").unwrap();
        let set = ["task.kwargs.set=3", "task.kwargs.last=set"].map(str::to_owned);
        let flags = ["flag = dense", "last=\"flag\""].map(str::to_owned);
        let mut sources = sources("Pendulum-v1");
        sources.file = Some(file.path());
        sources.environment = vec![
            variable("DMPRL_TASK__KWARGS__VARIABLE", "2.0"),
            variable("DMPRL_TASK__KWARGS__LAST", "variable"),
        ];
        (sources.set, sources.env_kwargs) = (&set, &flags);
        let kwargs = merge(&sources).unwrap().task.kwargs;
        let expected = "file = 1\nvariable = 2.0\nset = 3\nflag = 'dense'\nlast = 'flag'";
        assert_eq!(kwargs, expected.parse().unwrap());
    }

    #[test]
    fn arguments_of_the_environment_need_an_equals_sign_and_tomls_notation() {
        for (pair, words) in [
            ("reward_type", "--env-kwargs reward_type: expected KEY=VALUE"),
            ("dense=False", "--env-kwargs: `task.kwargs.dense` = False: expected a TOML value"),
        ] {
            let pairs = [pair.to_owned()];
            let mut sources = sources("Pendulum-v1");
            sources.env_kwargs = &pairs;
            assert!(refused(sources).contains(words), "{pair}");
        }
    }

    #[test]
    fn a_file_overrides_the_preset_and_the_preset_the_task() {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        writeln!(file, "[dmp]\nalpha_y = 12").unwrap();
        let mut paper = sources("reacher");
        paper.preset = "paper";
        assert_eq!(merge(&paper).unwrap().dmp.alpha_y, 25.0);
        let mut with_file = sources("reacher");
        with_file.preset = "paper";
        with_file.file = Some(file.path());
        assert_eq!(merge(&with_file).unwrap().dmp.alpha_y, 12.0);
    }

    #[test]
    fn an_unknown_environment_variable_is_rejected_with_the_nearest_key() {
        let mut sources = sources("reacher");
        sources.environment = vec![variable("DMPRL_ALGORITHM__BACH_SIZE", "64")];
        let message = refused(sources);
        assert!(message.contains("DMPRL_ALGORITHM__BACH_SIZE"), "{message}");
        assert!(message.contains("did you mean `algorithm.batch_size`"), "{message}");
    }

    #[test]
    fn an_unknown_task_is_rejected_with_the_nearest_name() {
        for name in ["reachr", "Reacher", "pushr"] {
            assert!(refused(sources(name)).contains("did you mean `"), "{name}");
        }
        for name in [
            "",
            "zzz",
            "../etc-v1",
            "a b-v1",
            "os;x:Y-v1",
            "Y-v",
            "Y-v1.0",
            "m:",
            ":C",
            "m..n:C",
            "m:C.D",
        ] {
            assert!(refused(sources(name)).contains("unknown task"), "{name}");
        }
    }

    #[test]
    fn gymnasium_ids_and_classes_are_tasks() {
        let ids = ["Pendulum-v1", "my.module:Arm-v0", "ALE/Pong-v5", "a:b/C.d-e-v12"];
        for name in ids.into_iter().chain(["my_module:MyArm", "my.module:_Arm2"]) {
            let config = merge(&sources(name)).unwrap();
            assert_eq!((config.task.id.as_str(), config.task.name.as_str()), (name, name));
        }
    }

    #[test]
    fn a_configuration_for_another_task_is_rejected() {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        writeln!(file, "[task]\nname = 'pusher'\nid = 'Pusher-v5'").unwrap();
        let mut sources = sources("reacher");
        sources.file = Some(file.path());
        assert!(refused(sources).contains("`pusher`"));
    }

    #[test]
    fn a_runs_configuration_file_reproduces_its_configuration() {
        let parent = tempfile::tempdir().unwrap();
        let limits = dmprl_shared::config::Limits { cores: 4 };
        let mut first = sources("pusher");
        first.preset = "paper";
        let config = merge(&first).unwrap().resolve(limits).unwrap();
        let manifest = dmprl_run::Manifest::new(None).unwrap();
        let path = parent.path().join("run");
        dmprl_run::RunDirectory::create(&path, &config, &manifest).unwrap();
        let file = path.join("config.toml");
        let mut second = sources("pusher");
        second.file = Some(&file);
        assert_eq!(merge(&second).unwrap().resolve(limits).unwrap(), config);
    }

    #[test]
    fn ndp_defaults_override_presets_but_not_the_users_settings() {
        for preset in ["default", "paper"] {
            let set = ["algorithm.name=ndp".to_owned(), "policy.start=zero".to_owned()];
            let ndp = Sources { preset, set: &set[..1], ..sources("panda-reach") };
            let config = merge(&ndp).unwrap().resolve(Limits { cores: 2 }).unwrap();
            assert_eq!(config.policy.controller, Controller::Position);
            assert_eq!(
                (config.policy.start, config.policy.position_scale),
                (Start::Observed, 20.0)
            );
            assert_eq!(config.dmp.integrator, Integrator::Explicit);
            assert_eq!(config.dmp.forcing_scaling, ForcingScaling::Goal);
            assert_eq!(config.exploration.warm_up_steps, 0);
            let user_set = Sources { preset, set: &set, ..sources("panda-reach") };
            assert_eq!(merge(&user_set).unwrap().policy.start, Start::Zero);
        }
    }

    #[test]
    fn tasks_with_objects_discount_more_than_the_preset_goal_but_the_user_decides() {
        let discount = |task, set: &[String]| {
            let sources = Sources { preset: "goal", set, ..sources(task) };
            merge(&sources).unwrap().algorithm.discount
        };
        let own = ["algorithm.discount=0.9".to_owned()];
        assert_eq!(discount("panda-push", &[]), 0.95);
        assert_eq!(discount("panda-push", &own), 0.9);
        assert_eq!(discount("panda-reach", &[]), 0.98);
    }

    #[test]
    fn set_needs_an_equals_sign() {
        let set = ["run.steps".to_owned()];
        let mut sources = sources("reacher");
        sources.set = &set;
        assert!(refused(sources).contains("KEY=VALUE"));
    }

    #[test]
    fn an_mlp_does_one_update_per_step_by_default() {
        let kind = [String::from("policy.kind=mlp")];
        let mlp = Sources { set: &kind, ..sources("reacher") };
        assert_eq!(merge(&mlp).unwrap().pacing.updates_per_segment, 1.0);
        let both = [kind[0].clone(), String::from("pacing.updates_per_segment=3")];
        let user_set = Sources { set: &both, ..sources("reacher") };
        assert_eq!(merge(&user_set).unwrap().pacing.updates_per_segment, 3.0);
        assert_eq!(merge(&sources("reacher")).unwrap().pacing.updates_per_segment, 2.0);
        for preset in PRESETS.iter().map(|preset| preset.name) {
            let mlp = Sources { set: &kind, preset, ..sources("panda-push") };
            assert_eq!(merge(&mlp).unwrap().pacing.updates_per_segment, 1.0, "{preset}");
        }
    }
}
