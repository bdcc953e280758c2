//! Encodes the whole policy as an ONNX graph: network, DMP, controller and action scaling.
//!
//! ```text
//!   observation (batch, O) ─┐                                       ┌─► actions (batch, K, A)
//!                           ├─ Gemm, Relu … ─ Tanh ─ MatMul ─ … ────┤
//!   state (batch, 2A) ──────┘  network        ranges  DMP's map     └─► next_state (batch, 2A)
//! ```
//! `state` and `next_state` exist only if segments start where the previous one ended. The graph
//! computes the same as `dmprl_shared::policy`, in the same order; a test compares the two.

use anyhow::Context;
use dmprl_shared::config::{Controller, ForcingScaling, RhoKind, StartSource};
use dmprl_shared::policy::{CommandState, Head, PolicyDescription};
use dmprl_shared::policy_file::OpenedPolicy;
use prost::Message;

use super::graph::{Graph, int, ints};
use super::onnx_format::{ModelProto, OperatorSetIdProto, StringStringEntryProto};

/// Version of the operator set. It dates from 2022, so current runtimes support it.
const OPSET_VERSION: i64 = 17;
/// Version of the file format that belongs to it.
const IR_VERSION: i64 = 8;

/// Encodes a policy as an ONNX file.
///
/// # Errors
/// The policy's description cannot be serialized, which is not expected.
pub fn onnx(opened: &OpenedPolicy) -> anyhow::Result<Vec<u8>> {
    let description = opened.policy.description();
    let json =
        serde_json::to_string(description).context("cannot serialize the policy's description")?;
    let entry = |key: &str, value: String| StringStringEntryProto { key: key.to_owned(), value };
    let mut metadata_props = vec![entry("description", json)];
    if let Some(origin) = &opened.origin {
        metadata_props.push(entry("origin", serde_json::to_string(origin)?));
    }
    if let Some(hold) = &opened.hold {
        metadata_props.push(entry("hold", serde_json::to_string(hold)?));
    }
    let model = ModelProto {
        ir_version: IR_VERSION,
        producer_name: "dmprl".into(),
        producer_version: env!("CARGO_PKG_VERSION").into(),
        model_version: i64::try_from(opened.snapshot.version).unwrap_or(i64::MAX),
        doc_string: format!(
            "dmprl policy for {}: maps an observation to the actions of the next control steps, \
             in the environment's units.",
            description.spec.id
        ),
        graph: Some(PolicyGraph::new(opened).build().finish()),
        opset_import: vec![OperatorSetIdProto { domain: String::new(), version: OPSET_VERSION }],
        metadata_props,
    };
    Ok(model.encode_to_vec())
}

/// Builds the graph of a policy.
struct PolicyGraph<'a> {
    opened: &'a OpenedPolicy,
    description: &'a PolicyDescription,
    graph: Graph,
    /// A, the number of action dimensions.
    dims: usize,
    /// K, the number of steps of a segment.
    steps: usize,
}

/// Names of the DMP's initial position and velocity, (batch, A, 1) each.
struct Start {
    y: String,
    yd: String,
}

impl<'a> PolicyGraph<'a> {
    fn new(opened: &'a OpenedPolicy) -> Self {
        let layout = opened.policy.layout();
        Self {
            description: opened.policy.description(),
            opened,
            graph: Graph::new("policy"),
            dims: layout.action_len,
            steps: layout.segment_steps,
        }
    }

    fn build(mut self) -> Graph {
        let about = "(batch, O), in the environment's units";
        let len = self.description.spec.observation_len;
        let observation = self.graph.input("observation", len, about);
        let state = (self.opened.policy.state_len() > 0).then(|| {
            let about = "(batch, 2A): y, then yd, at the start of the segment; zeros at the start \
                         of an episode, then the previous next_state";
            self.graph.input("state", 2 * self.dims, about)
        });
        let network_input = match &state {
            Some(state) => self.graph.concat(&[&observation, state], 1),
            None => observation.clone(),
        };
        let outputs = self.network(network_input);
        let u = match self.opened.policy.head() {
            Head::Mlp => {
                let u = self.graph.op("Tanh", &[&outputs]);
                self.graph.reshape(&u, &[-1, self.steps as i64, self.dims as i64])
            }
            Head::Dmp(_) => self.segment(&outputs, &observation, state.as_deref()),
        };
        if let (Some(_), Some(state)) = (self.opened.policy.command_state(), &state) {
            self.next_command_state(&u, state);
        }
        self.scale_actions(&u);
        self.graph
    }

    /// Adds the network; returns its outputs, (batch, D), without the standard deviations of a
    /// Gaussian policy.
    fn network(&mut self, mut x: String) -> String {
        let (policy, values) = (&self.opened.policy, &self.opened.snapshot.values);
        for (index, layer) in policy.shape().layers().iter().enumerate() {
            if index > 0 {
                x = self.graph.op("Relu", &[&x]);
            }
            let shape = [layer.outputs, layer.inputs];
            let weights = self.graph.constant(&shape, &values[layer.weights.clone()]);
            let bias = self.graph.constant(&[layer.outputs], &values[layer.bias.clone()]);
            x = self.graph.op_with("Gemm", &[&x, &weights, &bias], vec![int("transB", 1)]);
        }
        match policy.log_stds() {
            Some(log_stds) => self.graph.slice(&x, 1, 0, log_stds.start),
            None => x,
        }
    }

    /// Adds the movement primitive and its controller; returns u, (batch, K, A).
    fn segment(&mut self, outputs: &str, observation: &str, state: Option<&str>) -> String {
        let Head::Dmp(head) = self.opened.policy.head() else { return outputs.to_owned() };
        let (policy, basis_count) = (&self.description.policy, self.description.dmp.basis_count);
        let (map, dims, steps) = (head.map(), self.dims as i64, self.steps);
        let per_dimension = (head.outputs_len() / self.dims) as i64;
        let graph = &mut self.graph;
        let raw = graph.reshape(outputs, &[-1, dims, per_dimension]);
        let squashed = graph.op("Tanh", &[&raw]);
        let goal_range = graph.scalar(policy.goal_range as f32);
        let goal = graph.slice(&squashed, 2, 0, 1);
        let goal = graph.op("Mul", &[&goal, &goal_range]);
        let mut weights = graph.slice(&squashed, 2, 1, 1 + basis_count);
        let start = self.start(&goal, observation, state);
        let graph = &mut self.graph;
        if self.description.dmp.forcing_scaling == ForcingScaling::Goal {
            let distance = graph.op("Sub", &[&goal, &start.y]);
            weights = graph.op("Mul", &[&weights, &distance]);
        }
        let inputs = graph.concat(&[&start.y, &start.yd, &goal, &weights], 2);
        let (rows, columns) = (map.sample_count(), map.input_count());
        let transposed: Vec<f32> =
            (0..columns * rows).map(|at| map.matrix()[(at % rows) * columns + at / rows]).collect();
        let transposed = graph.constant(&[columns, rows], &transposed);
        let samples = graph.op("MatMul", &[&inputs, &transposed]);
        if self.opened.policy.carries_dmp_state() {
            self.next_state(&samples, head.omega());
        }
        let graph = &mut self.graph;
        let y = graph.slice(&samples, 2, 0, steps);
        let u = match policy.controller {
            Controller::Position => {
                let but_last = graph.slice(&y, 2, 0, steps - 1);
                let before = graph.concat(&[&start.y, &but_last], 2);
                let moved = graph.op("Sub", &[&y, &before]);
                let scale = graph.scalar(policy.position_scale as f32);
                graph.op("Mul", &[&moved, &scale])
            }
            Controller::Direct => graph.op("Tanh", &[&y]),
            Controller::Inverse => {
                let bounded = policy.rho == RhoKind::Bounded;
                let source = if bounded { &squashed } else { &raw };
                let range = if bounded { policy.rho_range as f32 } else { 1.0 };
                let rho = graph.slice(source, 2, 1 + basis_count, per_dimension as usize);
                self.inverse(&rho, range, &y, &samples)
            }
        };
        self.graph.op_with("Transpose", &[&u], vec![ints("perm", &[0, 2, 1])])
    }

    /// Adds the inverse controller: u = tanh(rho_0 y + rho_1 yd + rho_2 ydd + rho_3), with
    /// rho = (1, 0, 0, 0) + range · `rho`.
    fn inverse(&mut self, rho: &str, range: f32, y: &str, samples: &str) -> String {
        let (graph, steps) = (&mut self.graph, self.steps);
        let centre = graph.constant(&[1, 1, 4], &[1.0, 0.0, 0.0, 0.0]);
        let range = graph.scalar(range);
        let rho = graph.op("Mul", &[rho, &range]);
        let rho = graph.op("Add", &[&rho, &centre]);
        let of = |graph: &mut Graph, index: usize| graph.slice(&rho, 2, index, index + 1);
        let velocities = graph.slice(samples, 2, steps, 2 * steps);
        let accelerations = graph.slice(samples, 2, 2 * steps, 3 * steps);
        let mut sum = of(graph, 3);
        for (index, motion) in [y, &velocities, &accelerations].into_iter().enumerate() {
            let factor = of(graph, index);
            let term = graph.op("Mul", &[&factor, motion]);
            sum = graph.op("Add", &[&sum, &term]);
        }
        graph.op("Tanh", &[&sum])
    }

    /// Adds the output of the state after actions u, (batch, K, A), as `CommandState` computes it.
    fn next_command_state(&mut self, u: &str, state: &str) {
        let (graph, steps, dims) = (&mut self.graph, self.steps, self.dims as i64);
        let [least, most] = [-1.0, 1.0].map(|sign| graph.scalar(sign * CommandState::U_MAX));
        let clipped = graph.op("Clip", &[u, &least, &most]);
        // tanh⁻¹(u) = log((1 + u) / (1 - u)) / 2; ONNX's Atanh is missing in small runtimes.
        let [one, half] = [1.0, 0.5].map(|number| graph.scalar(number));
        let above = graph.op("Add", &[&one, &clipped]);
        let below = graph.op("Sub", &[&one, &clipped]);
        let ratio = graph.op("Div", &[&above, &below]);
        let ratio = graph.op("Log", &[&ratio]);
        let y = graph.op("Mul", &[&ratio, &half]);
        let last = graph.slice(&y, 1, steps - 1, steps);
        let last = graph.reshape(&last, &[-1, dims]);
        let before = if steps == 1 {
            graph.slice(state, 1, 0, self.dims)
        } else {
            let before = graph.slice(&y, 1, steps - 2, steps - 1);
            graph.reshape(&before, &[-1, dims])
        };
        let per_segment = graph.scalar(steps as f32);
        let moved = graph.op("Sub", &[&last, &before]);
        let yd = graph.op("Mul", &[&moved, &per_segment]);
        let state = graph.concat(&[&last, &yd], 1);
        let about = "(batch, 2A): state for the next decision";
        graph.output(&state, "next_state", &[2 * self.dims], about);
    }

    /// Adds the output (y_K, yd_K), (batch, 2A). The samples' velocities are in units of omega.
    fn next_state(&mut self, samples: &str, omega: f32) {
        let (graph, steps, dims) = (&mut self.graph, self.steps, self.dims as i64);
        let omega = graph.scalar(omega);
        let y = graph.slice(samples, 2, steps - 1, steps);
        let yd = graph.slice(samples, 2, 2 * steps - 1, 2 * steps);
        let yd = graph.op("Mul", &[&yd, &omega]);
        let [y, yd] = [y, yd].map(|part| graph.reshape(&part, &[-1, dims]));
        let state = graph.concat(&[&y, &yd], 1);
        let about = "(batch, 2A): state for the next decision";
        graph.output(&state, "next_state", &[2 * self.dims], about);
    }

    /// Adds the initial position and velocity of the movement primitive.
    fn start(&mut self, goal: &str, observation: &str, state: Option<&str>) -> Start {
        use dmprl_shared::config::Start as Kind;
        match (self.description.policy.start, state) {
            (Kind::Carry | Kind::Action, Some(state)) => {
                let (graph, dims) = (&mut self.graph, self.dims);
                let parts = [0..dims, dims..2 * dims].map(|part| {
                    let part = graph.slice(state, 1, part.start, part.end);
                    graph.reshape(&part, &[-1, dims as i64, 1])
                });
                let [y, yd] = parts;
                Start { y, yd }
            }
            (Kind::Observed, _) => self.observed_start(observation),
            _ => {
                // Zeros with the goal's shape, (batch, A, 1).
                let zero = self.graph.scalar(0.0);
                let zeros = self.graph.op("Mul", &[goal, &zero]);
                Start { y: zeros.clone(), yd: zeros }
            }
        }
    }

    fn observed_start(&mut self, observation: &str) -> Start {
        use dmprl_shared::config::StartVelocity;
        let (spec, policy) = (&self.description.spec, &self.description.policy);
        let (graph, sources) = (&mut self.graph, &self.description.start_sources);
        let mut positions = Vec::new();
        let mut velocities = Vec::new();
        for source in sources {
            positions.push(match source {
                StartSource::Angle { cos, sin, velocity } => {
                    velocities.push(*velocity);
                    let [sin, cos] = [*sin, *cos].map(|at| graph.gather(observation, &[at]));
                    angle(graph, &sin, &cos)
                }
                StartSource::Value { index, velocity, scale } => {
                    velocities.push(*velocity);
                    let scale = graph.scalar(*scale);
                    let value = graph.gather(observation, &[*index]);
                    graph.op("Mul", &[&value, &scale])
                }
            });
        }
        let positions: Vec<&str> = positions.iter().map(String::as_str).collect();
        let y = graph.concat(&positions, 1);
        let measured = policy.start_velocity == StartVelocity::Measured;
        let segment_s = policy.segment_steps as f64 * spec.control_dt_s;
        let scale = graph.scalar(if measured { segment_s as f32 } else { 0.0 });
        let yd = graph.gather(observation, &velocities);
        let yd = graph.op("Mul", &[&yd, &scale]);
        let [y, yd] = [y, yd].map(|part| graph.reshape(&part, &[-1, self.dims as i64, 1]));
        Start { y, yd }
    }

    /// Adds the output of actions, in the environment's units and within their bounds.
    fn scale_actions(&mut self, u: &str) {
        let (graph, spec, dims) = (&mut self.graph, &self.description.spec, self.dims);
        let bounds = || spec.action_low.iter().zip(&spec.action_high);
        let per_dimension = |graph: &mut Graph, numbers: Vec<f64>| {
            let numbers: Vec<f32> = numbers.into_iter().map(|number| number as f32).collect();
            graph.constant(&[1, 1, dims], &numbers)
        };
        let mid = per_dimension(graph, bounds().map(|(low, high)| 0.5 * (low + high)).collect());
        let range = 0.5 * self.description.policy.action_range;
        let half = per_dimension(graph, bounds().map(|(low, high)| range * (high - low)).collect());
        let [least, most] = [-1.0, 1.0].map(|bound| graph.scalar(bound));
        let u = graph.op("Clip", &[u, &least, &most]);
        let scaled = graph.op("Mul", &[&u, &half]);
        let scaled = graph.op("Add", &[&scaled, &mid]);
        // Rounding may have exceeded the bounds.
        let low = per_dimension(graph, spec.action_low.clone());
        let high = per_dimension(graph, spec.action_high.clone());
        let scaled = graph.op("Max", &[&scaled, &low]);
        let actions = graph.op("Min", &[&scaled, &high]);
        let about = "(batch, K, A): one action per control step, in the environment's units";
        graph.output(&actions, "actions", &[self.steps, dims], about);
    }
}

/// Adds atan2(sin, cos), for which ONNX has no operator.
fn angle(graph: &mut Graph, sin: &str, cos: &str) -> String {
    let zero = graph.scalar(0.0);
    let [pi, minus_pi] = [std::f32::consts::PI, -std::f32::consts::PI].map(|pi| graph.scalar(pi));
    let one = graph.scalar(1.0);
    // Replaces -0 by 0, because sin / -0 is infinite with the wrong sign. Adding 0 would do the
    // same, but runtimes optimise it away.
    let [sin, cos] = &[sin, cos].map(|part| {
        let is_zero = graph.op("Equal", &[part, &zero]);
        graph.op("Where", &[&is_zero, &zero, part])
    });
    let cos_is_zero = graph.op("Equal", &[cos, &zero]);
    let sin_is_zero = graph.op("Equal", &[sin, &zero]);
    let is_origin = graph.op("And", &[&cos_is_zero, &sin_is_zero]);
    // 0/0 is NaN, but atan2(0, 0) is 0.
    let cos_or_one = graph.op("Where", &[&is_origin, &one, cos]);
    let ratio = graph.op("Div", &[sin, &cos_or_one]);
    let half = graph.op("Atan", &[&ratio]);
    let is_left = graph.op("Less", &[&cos_or_one, &zero]);
    let is_below = graph.op("Less", &[sin, &zero]);
    let turn = graph.op("Where", &[&is_below, &minus_pi, &pi]);
    let turn = graph.op("Where", &[&is_left, &turn, &zero]);
    graph.op("Add", &[&half, &turn])
}
