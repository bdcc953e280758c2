//! The observer's process: records episodes of a saved policy.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use anyhow::Context;
use dmprl_actors::environments;
use dmprl_actors::python_env::{self, PythonEnvironments, SUCCESS_NOT_REPORTED, SUCCESS_YES};
use dmprl_actors::recording::{EpisodeRecord, Recorder};
use dmprl_actors::trace::{Trace, TracedSegment};
use dmprl_analysis::motion::{
    EpisodeDetails, Joint, JointKind, RecordedEpisode, RecordedSegment, Robot,
};
use dmprl_control::Report;
use dmprl_run::Setup;
use dmprl_shared::policy_file::{self, Match};
use dmprl_shared::spec::EnvSpec;
use dmprl_shared::supervision::Supervisor;
use serde::Serialize;

use super::environments::on_hang;
use super::{ControlPipe, ObserverArgs};

/// Records the episodes that the arguments name, and reports each one.
pub fn run(args: &ObserverArgs, control: &ControlPipe) -> anyhow::Result<()> {
    let setup = Setup::read(&args.run)?;
    let interpreter = super::actor::start_interpreter(args.venv.as_deref(), &setup.config)?;
    let environment = PythonEnvironments::start_recording(
        &interpreter,
        &setup.config.task,
        setup.config.policy.execution_steps(),
        args.pictures.as_deref(),
    )?;
    environments::watch(&environment, &setup.config, on_hang(control))?;
    let spec = environment.spec().clone();
    let done = Arc::new(AtomicU64::new(0));
    let (episodes, reporter) = (Arc::clone(&done), control.reporter());
    let on_steps = Box::new(move |steps| {
        // If the supervisor is gone, the loop notices it as a stop.
        let episodes = episodes.load(Ordering::Relaxed);
        let _ = reporter.send(&Report::Observed { episodes, steps: steps as u64 });
    });
    let mut recorder = Recorder::new(&setup.config, environment, on_steps)?;
    let path = setup.run.policy_path(args.policy);
    let snapshot = policy_file::load(&path, recorder.policy(), Match::Architecture)?;
    let file = File::create(&args.output)
        .with_context(|| format!("cannot write {}", args.output.display()))?;
    let mut lines = BufWriter::new(file);
    append(&mut lines, &robot(&recorder, spec.control_dt_s))?;
    control.send(&Report::EnvironmentReady { spec: spec.clone() })?;
    let stop = control.stop_flag();
    for index in 0..args.episodes {
        let seed = args.first_seed + index;
        let record = recorder.record(&snapshot.values, seed, stop);
        environments::report_failures(&recorder.take_failures(), control);
        let Some(record) = record? else { return Ok(()) };
        let details = args.details.then(|| details(&record.trace, &spec));
        let episode = RecordedEpisode { details, ..episode(record, spec.action_len) };
        append(&mut lines, &episode)?;
        done.store(index + 1, Ordering::Relaxed);
        control.send(&Report::Observed { episodes: index + 1, steps: 0 })?;
    }
    Ok(())
}

/// Appends a line and flushes it, because the parent may kill this process after the report.
fn append(lines: &mut BufWriter<File>, object: &impl Serialize) -> anyhow::Result<()> {
    serde_json::to_writer(&mut *lines, object).context("cannot write an episode")?;
    lines.write_all(b"\n").and_then(|()| lines.flush()).context("cannot write an episode")
}

fn robot(recorder: &Recorder, control_dt_s: f64) -> Robot {
    let joints = recorder.joints();
    let kind = |kind| match kind {
        python_env::JointKind::Hinge => JointKind::Hinge,
        python_env::JointKind::Slide => JointKind::Slide,
    };
    let of = |(name, of): &(String, _)| Joint { name: name.clone(), kind: kind(*of) };
    Robot {
        joints: joints.joints.iter().map(of).collect(),
        why_no_joints: joints.why_none.clone(),
        goal_in_pictures: recorder.goal_in_pictures().to_owned(),
        control_dt_s,
    }
}

fn episode(record: EpisodeRecord, dims: usize) -> RecordedEpisode {
    let success = |flag: &u8| (*flag != SUCCESS_NOT_REPORTED).then_some(*flag == SUCCESS_YES);
    RecordedEpisode {
        seed: record.seed,
        return_: record.return_,
        success: record.success,
        rewards: record.trace.rewards,
        actions: record.trace.u.chunks_exact(dims).map(<[f32]>::to_vec).collect(),
        joint_positions: record.recording.joint_positions,
        joint_velocities: record.recording.joint_velocities,
        success_by_step: record.recording.success.iter().map(success).collect(),
        frames: record.recording.frames.into_iter().map(PathBuf::from).collect(),
        frame_steps: record.recording.frame_steps,
        details: None,
    }
}

fn details(trace: &Trace, spec: &EnvSpec) -> EpisodeDetails {
    let rows = |values: &[f64], len| values.chunks_exact(len).map(<[f64]>::to_vec).collect();
    EpisodeDetails {
        observation_names: spec.observation_names.clone(),
        observations: rows(&trace.observations, spec.observation_len),
        commands: rows(&trace.actions, spec.action_len),
        segments: trace.segments.iter().map(segment).collect(),
    }
}

fn segment(traced: &TracedSegment) -> RecordedSegment {
    let TracedSegment { first_step, steps, primitives } = traced.clone();
    RecordedSegment { first_step, steps, primitives }
}
