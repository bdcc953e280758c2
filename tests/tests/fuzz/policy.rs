//! Policy files.

use std::fs;

use dmprl_shared::parameters::ParameterSnapshot;
use dmprl_shared::policy::{Hold, Policy};
use dmprl_shared::policy_file::{self, Match};

use crate::mutate;
use crate::{Target, Verdict, fixture};

#[test]
fn one_that_is_accepted_is_finite_and_stays_what_it_is() {
    let target = Target {
        name: "policy::one_that_is_accepted_is_finite_and_stays_what_it_is",
        cases: 4_000,
        bytes_max: 1 << 20,
    };
    let folder = fixture::folder();
    let path = folder.path().join("1.safetensors");
    let policy = Policy::new(fixture::config(&[]).policy_description(&fixture::spec())).unwrap();
    let made = [1, 2].map(|version| {
        let values = policy.initial_parameters(&mut dmprl_shared::seeds::stream(version, "p", 0));
        let architecture_hash = policy.architecture_hash();
        let snapshot =
            ParameterSnapshot { version, env_steps: 10, architecture_hash, settled: false, values };
        let hold = (version == 2).then_some(&Hold::ZeroVelocity);
        policy_file::encode(&policy, &snapshot, None, hold).unwrap()
    });
    target.fuzz(|random| {
        let mut bytes = random.pick(&made).clone();
        if random.once_in(3) {
            // A number in the tensors at the end of the file.
            let at = bytes.len() - 4 * (1 + random.below(8));
            bytes[at..at + 4].copy_from_slice(&random.float().to_le_bytes());
        } else if random.once_in(3) {
            // The length of the header, or the header's text.
            let at = 8 + random.below(200);
            bytes[at] = *random.pick(b"0123456789[]{}\",:eE-");
            if random.once_in(4) {
                let word = random.number().to_le_bytes();
                bytes[..8].copy_from_slice(&word);
            }
        } else {
            mutate::bytes(random, &mut bytes, &made[1]);
        }
        fs::write(&path, &bytes).unwrap();
        let strictness = *random.pick(&[Match::Architecture, Match::Sizes]);
        if let Ok(opened) = policy_file::open(&path) {
            assert_eq!(opened.snapshot.values.len(), opened.policy.parameters_len());
            let spec = &opened.policy.description().spec;
            assert!(opened.hold.is_none_or(|hold| hold.action(spec).is_ok()));
        }
        let loaded = policy_file::load(&path, &policy, strictness);
        if let Ok(snapshot) = &loaded {
            assert_eq!(snapshot.values.len(), policy.parameters_len());
            assert!(snapshot.values.iter().all(|value| value.is_finite()));
            fs::write(&path, policy_file::encode(&policy, snapshot, None, None).unwrap()).unwrap();
            let again = policy_file::load(&path, &policy, Match::Architecture).unwrap();
            assert_eq!(again, *snapshot);
        }
        Verdict::of(&loaded)
    });
}
