//! Compares `dmprl.Policy`, which uses only NumPy, with the Rust runtime: the same actions and the
//! same errors.
#![cfg(feature = "python")]
#![allow(
    clippy::unwrap_used,
    reason = "helpers of tests; clippy.toml covers only the tests themselves"
)]

use std::path::Path;
use std::process::Command;

use dmprl_shared::runtime::PolicyRuntime;
use dmprl_tests::exported::{self, KINDS, read_numbers, write_numbers};
use dmprl_tests::{project_root, venv};

/// Both compute in f32 and sum in different orders.
const TOLERANCE: f64 = 1e-5;
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
    assert!(largest <= TOLERANCE, "{what}: off by {largest}, at most {TOLERANCE}");
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
fn numpy_limits_and_holds_as_rust_does() {
    let folder = tempfile::tempdir().unwrap();
    exported::write(folder.path());
    let script = "
import pathlib, dmprl, numpy as np
for folder in pathlib.Path(sys.argv[1]).iterdir():
    policy = dmprl.Policy.load(folder / 'policy.safetensors')
    policy.limit(rate=0.3, hold=np.full(policy.low.size, 0.5), hold_after=2)
    policy.reset()
    rows = np.fromfile(folder / 'observations.f64').reshape(-1, policy.spec['observation_len'])
    seen = np.fromfile(folder / 'seen.f64')
    actions = []
    for row, is_seen in zip(rows, seen):
        actions.append(np.append(policy.action(row if is_seen else None), policy.is_holding))
    np.stack(actions).tofile(folder / 'numpy.f64')
";
    // Gaps of every length up to 6 at every step of a segment.
    let seen: Vec<f64> =
        (0..STEPS).map(|step| f64::from(u8::from(step % 17 >= step / 17))).collect();
    assert!(seen.contains(&0.0));
    let mut held = 0;
    for (name, ..) in KINDS {
        write_numbers(&folder.path().join(name).join("seen.f64"), &seen);
    }
    python(script, folder.path());
    for (name, ..) in KINDS {
        let folder = folder.path().join(name);
        let mut policy = PolicyRuntime::load(&folder.join("policy.safetensors")).unwrap();
        let (dims, len) = (policy.spec().action_len, policy.spec().observation_len);
        policy.safety_mut().set_rate(&vec![0.3; dims]).unwrap();
        policy.safety_mut().set_hold(&vec![0.5; dims]).unwrap();
        policy.safety_mut().set_hold_after(2);
        policy.reset(None).unwrap();
        let observations = read_numbers(&folder.join("observations.f64"));
        let mut expected = Vec::new();
        for (row, &seen) in observations.chunks(len).zip(&seen) {
            expected.extend_from_slice(policy.action((seen > 0.0).then_some(row)).unwrap());
            expected.push(f64::from(u8::from(policy.is_holding())));
            held += usize::from(policy.is_holding());
        }
        assert_near(&read_numbers(&folder.join("numpy.f64")), &expected, name);
    }
    assert!(held > 0, "nothing held: this shows nothing");
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
    refused(lambda: policy.limit(rate=0.0), 'rate', 'positive')
    refused(lambda: policy.limit(hold=np.full(policy.low.size, 9.0)), 'hold', 'expected')
    refused(lambda: policy.limit(hold_after=-1), 'hold_after')
    refused(lambda: policy.reset(np.zeros(99)), 'y0')
    policy.limit(rate=0.05, hold=np.full(policy.low.size, 0.5))
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
