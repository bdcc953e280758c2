//! Compares `dmprl.Policy`, which uses only NumPy, with the Rust runtime: the same actions and the
//! same errors.
#![cfg(feature = "python")]
#![allow(
    clippy::unwrap_used,
    reason = "helpers of tests; clippy.toml covers only the tests themselves"
)]

use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use dmprl_analysis::export;
use dmprl_runtime::{PolicyRuntime, RuntimeError};
use dmprl_shared::policy::Hold;
use dmprl_tests::exported::{self, KINDS, read_numbers, write_numbers};
use dmprl_tests::{project_root, venv};

/// Both compute in f32 and sum in different orders.
const TOLERANCE: f64 = 1e-5;
/// The same for policies that see tanh⁻¹ of the last action, which multiplies rounding errors by up
/// to 100 near the bounds.
const TOLERANCE_ACTION: f64 = 1e-4;
/// Number of control steps in the second test.
const STEPS: usize = 120;

/// Runs a script with NumPy and the package, and no other modules to import.
fn python(script: &str, folder: &Path) -> String {
    let alone = "import sys\nfor name in ('gymnasium', 'mujoco', 'safetensors'):\n    \
                 sys.modules[name] = None\n";
    let output = Command::new(&venv().executable)
        .args(["-c", &format!("{alone}{script}")])
        .arg(folder)
        .current_dir(project_root())
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

fn assert_near(got: &[f64], expected: &[f64], what: &str) {
    assert_eq!(got.len(), expected.len(), "{what}");
    let largest = got.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    let tolerance = if what.starts_with("action") { TOLERANCE_ACTION } else { TOLERANCE };
    assert!(largest <= tolerance, "{what}: off by {largest}, at most {tolerance}");
}

#[test]
fn numpy_decides_what_rust_decides() {
    let folder = tempfile::tempdir().unwrap();
    exported::write(folder.path());
    let script = "
import pathlib, dmprl, numpy as np
for folder in pathlib.Path(sys.argv[1]).iterdir():
    policy = dmprl.Policy.load(folder / 'policy.safetensors')
    rows = np.fromfile(folder / 'observations.f64').reshape(-1, policy.spec['observation_len'])
    np.stack([policy.segment(row) for row in rows]).tofile(folder / 'numpy.f64')
";
    python(script, folder.path());
    for (name, ..) in KINDS {
        let read = |file: &str| read_numbers(&folder.path().join(name).join(file));
        let expected = read("segments.f64");
        let spread = expected.iter().fold(0.0_f64, |largest, action| largest.max(action.abs()));
        assert!(spread > 0.1, "{name}: actions of nothing compare nothing");
        assert_near(&read("numpy.f64"), &expected, name);
    }
}

#[test]
fn predict_acts_as_one_policy_for_each_environment() {
    let folder = tempfile::tempdir().unwrap();
    exported::write(folder.path());
    let script = "
import copy, pathlib, dmprl, numpy as np
for folder in pathlib.Path(sys.argv[1]).iterdir():
    load = lambda: dmprl.Policy.load(folder / 'policy.safetensors')
    rows = np.fromfile(folder / 'observations.f64').reshape(-1, load().spec['observation_len'])
    together, alone = load(), [load() for _ in range(3)]
    starts = np.ones(3, bool)
    for step in range(20):
        seen = rows[step : step + 3]
        actions, state = together.predict(seen, None, starts, deterministic=True)
        for policy, start in zip(alone, starts):
            if start:
                policy.reset()
        expected = [policy.action(row) for policy, row in zip(alone, seen)]
        assert state is None and (actions == expected).all(), (folder, step)
        # Episodes start in each environment alone, in the middle of segments of the others.
        starts = np.array([step == 3, step == 6, step % 4 == 0])
        if step == 11:
            for policy in (together, *alone):
                policy.reset()
    limited = load()
    limited.limit(rate=0.1, hold=dmprl.Hold.position([0.5] * limited.low.size))
    twin = copy.deepcopy(limited)
    assert (twin.segment(rows[0]) == limited.segment(rows[0])).all(), folder
    together.limit(rate=0.1, hold=dmprl.Hold.position([0.5] * limited.low.size))
    actions, _ = together.predict(rows[:3], None, np.ones(3, bool))
    assert (np.abs(actions - 0.5) <= 0.1 + 1e-9).all(), folder
";
    python(script, folder.path());
}

#[test]
fn numpy_limits_and_holds_as_rust_does() {
    let folder = tempfile::tempdir().unwrap();
    exported::write(folder.path());
    let script = "
import pathlib, dmprl, numpy as np
for folder in pathlib.Path(sys.argv[1]).iterdir():
    policy = dmprl.Policy.load(folder / 'policy.safetensors')
    policy.limit(rate=0.3, hold=dmprl.Hold.position([0.5] * policy.low.size), hold_after=2)
    now = 0.0
    policy.limit(deadline_s=0.2, clock=lambda: now)
    policy.reset()
    rows = np.fromfile(folder / 'observations.f64').reshape(-1, policy.spec['observation_len'])
    seen = np.fromfile(folder / 'seen.f64')
    times = np.fromfile(folder / 'times.f64')
    actions = []
    for row, is_seen, now in zip(rows, seen, times):
        actions.append(np.append(policy.action(row if is_seen else None), policy.is_holding))
    policy.hold_until_reached(lambda action: actions.append(np.append(action, policy.is_holding)))
    np.stack(actions).tofile(folder / 'numpy.f64')
";
    // Gaps of every length up to 6 at every step of a segment.
    let seen: Vec<f64> =
        (0..STEPS).map(|step| f64::from(u8::from(step % 17 >= step / 17))).collect();
    assert!(seen.contains(&0.0));
    // The caller is frozen before every 31st call.
    let times: Vec<f64> =
        (0..STEPS).map(|step| 0.1 * step as f64 + 0.5 * (step / 31) as f64).collect();
    let (mut held, mut frozen, mut approaches) = (0, 0, 0);
    for (name, ..) in KINDS {
        write_numbers(&folder.path().join(name).join("seen.f64"), &seen);
        write_numbers(&folder.path().join(name).join("times.f64"), &times);
    }
    python(script, folder.path());
    for (name, ..) in KINDS {
        let folder = folder.path().join(name);
        let mut policy = PolicyRuntime::load(&folder.join("policy.safetensors")).unwrap();
        let (dims, len) = (policy.spec().action_len, policy.spec().observation_len);
        policy.safety_mut().set_hold(&Hold::Position { values: vec![0.5; dims] }).unwrap();
        policy.safety_mut().set_rate(&vec![0.3; dims]).unwrap();
        policy.safety_mut().set_hold_after(2).unwrap();
        let now_ms = Arc::new(AtomicU64::new(0));
        let clock = Arc::clone(&now_ms);
        policy.set_deadline(0.2, move || clock.load(Ordering::Relaxed) as f64 * 1e-3).unwrap();
        policy.reset(None).unwrap();
        let observations = read_numbers(&folder.join("observations.f64"));
        let mut expected = Vec::new();
        for ((row, &seen), &now) in observations.chunks(len).zip(&seen).zip(&times) {
            now_ms.store((now * 1e3).round() as u64, Ordering::Relaxed);
            expected.extend_from_slice(policy.action((seen > 0.0).then_some(row)).unwrap());
            expected.push(f64::from(u8::from(policy.is_holding())));
            held += usize::from(policy.is_holding());
            frozen += usize::from(policy.is_holding() && seen > 0.0);
        }
        let sent = policy.hold_until_reached(|action| {
            expected.extend_from_slice(action);
            expected.push(1.0);
            Ok::<(), RuntimeError>(())
        });
        approaches += usize::from(sent.unwrap() > 1);
        assert_near(&read_numbers(&folder.join("numpy.f64")), &expected, name);
    }
    assert!(frozen > 0 && held > frozen && approaches > 0, "nothing held: this shows nothing");
}

/// Beginning of a script: `refused` checks for an error and its message.
const REFUSED: &str = "
import pathlib, dmprl, numpy as np
folder = pathlib.Path(sys.argv[1])
def refused(call, *words, kind=ValueError):
    try:
        call()
    except kind as error:
        assert all(word in str(error) for word in words), error
    else:
        raise AssertionError(words)
";

#[test]
fn numpy_refuses_what_is_no_observation_and_no_limit() {
    let folder = tempfile::tempdir().unwrap();
    exported::write(folder.path());
    let script = "
for name in ('dmp', 'carry', 'mlp'):
    policy, calm = (dmprl.Policy.load(folder / name / 'policy.safetensors') for _ in range(2))
    length = policy.spec['observation_len']
    for step in range(12):
        for bad, words in [
            (np.zeros(length - 1), ('shape', f'({length},)')),
            (np.zeros((1, length)), ('shape',)),
            (np.where(np.arange(length) == 1, np.nan, 0.0), ('observation[1]', 'nan')),
            (np.where(np.arange(length) == 2, 1e300, 0.0), ('observation[2]', '1e+300')),
        ]:
            refused(lambda: policy.action(bad), *words)
        now = np.sin(step + np.arange(length))
        assert (policy.action(now) == calm.action(now)).all()
    big = [policy.segment(np.sin(np.arange(length)) * 10.0**n) for n in range(30)]
    assert all(((b >= policy.low) & (b <= policy.high)).all() for b in big)
    for unheld in (
        lambda: policy.limit(rate=0.1),
        lambda: policy.limit(deadline_s=0.1),
        policy.action,
        policy.hold,
        lambda: policy.hold_until_reached(print),
    ):
        refused(unheld, 'dmprl export --hold', 'policy.limit(hold=', kind=dmprl.NoHoldError)
    held = dmprl.Hold.position([0.5] * policy.low.size)
    refused(lambda: policy.limit(hold=0.5), 'hold', 'dmprl.Hold.position(values)')
    refused(lambda: policy.limit(hold=dmprl.Hold.position([9.0] * policy.low.size)), 'expected')
    refused(lambda: policy.limit(hold=dmprl.Hold.position([0.5])), 'hold has 1 values')
    refused(lambda: policy.limit(hold=held, rate=0.0), 'rate', '10000 control steps')
    refused(lambda: policy.limit(hold=held, rate=1e-9), 'rate', '10000 control steps')
    refused(lambda: policy.limit(hold=held, hold_after=-1), 'hold_after')
    refused(lambda: policy.limit(hold=held, deadline_s=float('nan')), 'deadline_s')
    refused(policy.hold, kind=dmprl.NoHoldError)  # nothing has changed
    refused(lambda: policy.reset(np.zeros(99)), 'y0')
    policy.limit(rate=0.05, hold=held)
    policy.reset()
    before = np.full(policy.low.size, 0.5)
    for step in range(120):
        try:
            action = policy.action(np.full(length, np.nan if step // 20 % 2 else 0.1))
        except ValueError:
            action = policy.hold()
        assert (abs(action - before) <= 0.05 + 1e-12).all(), (step, action, before)
        assert policy.is_holding == bool(step // 20 % 2)
        before = action
    assert (abs(before - 0.5) < 1e-9).all(), before
    for step in range(20):
        policy.action(np.sin(step + np.arange(length)))
    commands = [policy.hold()]
    assert (commands[0] != 0.5).any(), 'one call is not enough'
    assert policy.hold_until_reached(commands.append) == len(commands) - 1 > 1
    assert (commands[-1] == 0.5).all(), commands[-1]
    assert (abs(np.diff(commands, axis=0)) <= 0.05 + 1e-12).all()
print('all refused')
";
    assert_eq!(python(&format!("{REFUSED}{script}"), folder.path()).trim(), "all refused");
}

#[test]
fn numpy_refuses_files_that_are_damaged_or_of_no_policy() {
    let folder = tempfile::tempdir().unwrap();
    exported::write(folder.path());
    let script = "
refused(lambda: dmprl.Policy.load(folder), 'checkpoints/best')
refused(lambda: dmprl.Policy.load(folder / 'none'), kind=OSError)
whole = (folder / 'dmp/policy.safetensors').read_bytes()
for damaged, word in [
    (whole[:1000], 'truncated'),
    (b'', 'safetensors'),
    (whole.replace(b'dmprl-policy-1', b'dmprl-policy-9'), 'dmprl-policy-9'),
    (whole.replace(b'\"description\"', b'\"descripti--\"'), 'dmprl export'),
    (whole.replace(b'\"actor.1.bias\"', b'\"actor.9.bias\"'), 'actor.1.weight'),
    (whole[:-4] + np.float32(np.nan).tobytes(), 'finite'),
    (whole[:-1] + bytes([whole[-1] ^ 1]), 'checksum'),
    (whole[:-400], 'damaged'),
]:
    (folder / 'damaged').write_bytes(damaged)
    refused(lambda: dmprl.Policy.load(folder / 'damaged'), word, kind=dmprl.PolicyFileError)
for text in ('', '0', 'zero', 'position', 'position=', 'position=a', 'zero-torque=1'):
    refused(lambda: dmprl.Hold.parse(text), 'zero-velocity')
    refused(lambda: dmprl.Hold.of_file({'kind': text}), 'hold')
import dataclasses, json
from dmprl.policy_file import read
good = read(folder / 'dmp/policy.safetensors').description
for change, word in [
    (lambda d: d['spec'].update(action_low=[float('nan'), 0.0]), 'action_low'),
    (lambda d: d['spec'].update(action_low=[4.0, 4.0]), 'below action_high'),
    (lambda d: d['spec'].update(action_high=[1.0]), 'action_high'),
    (lambda d: d['policy'].update(start='elsewhere'), 'policy.start'),
    (lambda d: d['policy'].update(rho='twisted'), 'policy.rho'),
    (lambda d: d['policy'].update(goal_range=float('inf')), 'goal_range'),
    (lambda d: d['policy'].update(kind='mlp'), 'actor'),
    (lambda d: (d['policy'].update(start='observed'), d.update(start_sources=[])), 'start_sources'),
    (lambda d: d['dmp'].update(basis_count=9), 'segment_map'),
    (lambda d: d.pop('spec'), 'spec'),
]:
    description = json.loads(json.dumps(good))
    change(description)
    file = dataclasses.replace(read(folder / 'dmp/policy.safetensors'), description=description)
    refused(lambda: dmprl.Policy(file), word, kind=(KeyError, ValueError))
random = np.random.default_rng(1)
for _ in range(500):
    damaged = bytearray(whole)
    for _ in range(random.integers(1, 4)):
        damaged[random.integers(0, min(3000, len(whole)))] = random.integers(0, 256)
    (folder / 'damaged').write_bytes(damaged)
    try:
        dmprl.Policy.load(folder / 'damaged')
    except dmprl.PolicyFileError:
        pass
print('all refused')
";
    assert_eq!(python(&format!("{REFUSED}{script}"), folder.path()).trim(), "all refused");
}

#[test]
fn hold_of_a_file_is_the_same_in_numpy() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("policy.safetensors");
    let mut opened = exported::policy("reacher", &[]);
    for (hold, action) in [
        (Hold::ZeroVelocity, [0.0, 0.0]),
        (Hold::ZeroTorque, [0.0, 0.0]),
        (Hold::Position { values: vec![0.25, -0.5] }, [0.25, -0.5]),
    ] {
        opened.hold = Some(hold.clone());
        std::fs::write(&path, export::safetensors(&opened).unwrap()).unwrap();
        let mut runtime = PolicyRuntime::load(&path).unwrap();
        assert_eq!(runtime.hold().unwrap(), action);
        let script = "
policy = dmprl.Policy.load(folder / 'policy.safetensors')
assert dmprl.Hold.parse(sys.argv[2]) == policy.file.hold, policy.file.hold
print(policy.hold().tolist())
whole = (folder / 'policy.safetensors').read_bytes()
for old, new, word in [
    (b'\"hold\"', b'\"hald\"', 'format'),
    (b'dmprl-policy-2', b'dmprl-policy-1', 'format'),
    (b'zero-velocity', b'zero-velocitz', 'checksum'),
]:
    if old in whole:
        (folder / 'damaged').write_bytes(whole.replace(old, new))
        refused(lambda: dmprl.Policy.load(folder / 'damaged'), word, kind=dmprl.PolicyFileError)
";
        let script = format!("{REFUSED}{script}").replace("sys.argv[2]", &format!("'{hold}'"));
        assert_eq!(python(&script, folder.path()).trim(), format!("{action:?}"));
    }
}
