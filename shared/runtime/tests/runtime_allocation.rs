//! Checks that the policy runtime does not allocate after its start, so that the duration of a
//! control step does not vary.

#![allow(clippy::unwrap_used, reason = "a test's helpers fail the test")]

#[path = "../../tests/counting_allocator/mod.rs"]
mod counting_allocator;

use counting_allocator::allocations_of;
use dmprl_runtime::config::{AlgorithmName, DmpConfig, PolicyConfig, PolicyKind, Start};
use dmprl_runtime::policy::{Hold, Policy, PolicyDescription};
use dmprl_runtime::spec::EnvSpec;
use dmprl_runtime::{PolicyRuntime, seeds};

/// The only test in its binary, because the counter counts all threads.
#[test]
fn decisions_steps_and_holds_allocate_nothing() {
    let spec = EnvSpec::new("Test-v0", 4, &[(-1.0, 1.0); 2], 0.05, 50);
    for config in [
        PolicyConfig::default(),
        PolicyConfig { kind: PolicyKind::Mlp, ..PolicyConfig::default() },
        PolicyConfig { start: Start::Carry, ..PolicyConfig::default() },
        PolicyConfig { start: Start::Action, ..PolicyConfig::default() },
    ] {
        let description = PolicyDescription {
            spec: spec.clone(),
            algorithm: AlgorithmName::Td3,
            policy: config.clone(),
            dmp: DmpConfig::default(),
            start_sources: Vec::new(),
            task_options: None,
        };
        let policy = Policy::new(description).unwrap();
        let parameters = policy.initial_parameters(&mut seeds::stream(1, "test", 0));
        let mut runtime = PolicyRuntime::new(policy, &parameters);
        let observation = [0.1, -0.2, 0.3, -0.4];
        runtime.safety_mut().set_hold(&Hold::ZeroVelocity).unwrap();
        runtime.set_deadline(1.0, || 0.0).unwrap();
        // gemm allocates its buffers in the first product.
        runtime.segment(&observation).unwrap();
        let allocated = allocations_of(|| {
            for step in 0..100 {
                runtime.segment(&observation).unwrap();
                runtime.action((step % 3 > 0).then_some(&observation[..])).unwrap();
                runtime.hold().unwrap();
                runtime.reset(None).unwrap();
            }
        });
        assert_eq!(allocated, 0, "{config:?}");
    }
}
