//! Lists the matrix products of an update of DDPG, TD3, SAC and TQC, whose time is the floor.

use dmprl_learner::algorithms::BatchShape;
use dmprl_learner::learner::Learner;
use dmprl_learner::regime::Regime;
use dmprl_shared::config::AlgorithmName;
use dmprl_shared::policy::{Layer, MlpShape};

/// The products of the shortest sequence of updates that repeats.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Cycle {
    /// Products of all updates of the cycle.
    pub(super) products: Vec<Product>,
    /// Number of updates in the cycle. TD3 updates its actor only in the last one.
    pub(super) updates: u64,
}

/// Kind of a product, by its result for a layer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ProductKind {
    /// Y = X Wᵀ.
    Forward,
    /// dX = dY W.
    Backward,
    /// dW = dYᵀ X.
    WeightGradient,
}

/// One matrix product of an update: rows * inputs * outputs multiply-adds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Product {
    pub(super) kind: ProductKind,
    /// Rows of the batch.
    pub(super) rows: usize,
    /// Width of the layer's input, or of the part whose gradient is computed.
    pub(super) inputs: usize,
    /// Width of the layer's output.
    pub(super) outputs: usize,
}

impl Product {
    /// Returns the products of a forward pass.
    pub(super) fn forward(shape: &MlpShape, rows: usize) -> impl Iterator<Item = Self> + '_ {
        let of_layer = move |layer: &_| Self::of(ProductKind::Forward, rows, layer);
        shape.layers().iter().map(of_layer)
    }

    /// Returns the products of a backward pass down to the first layer's outputs.
    pub(super) fn backward(shape: &MlpShape, rows: usize) -> impl Iterator<Item = Self> + '_ {
        let of_layer = move |layer: &_| Self::of(ProductKind::Backward, rows, layer);
        shape.layers()[1..].iter().map(of_layer)
    }

    /// Returns the product for the gradient of the inputs from column `first` on. It follows
    /// [`Product::backward`].
    pub(super) fn input_gradient(shape: &MlpShape, rows: usize, first: usize) -> Self {
        let all = Self::of(ProductKind::Backward, rows, &shape.layers()[0]);
        Self { inputs: all.inputs - first, ..all }
    }

    /// Returns the products for the gradient of the parameters. They follow
    /// [`Product::backward`].
    pub(super) fn weight_gradient(
        shape: &MlpShape,
        rows: usize,
    ) -> impl Iterator<Item = Self> + '_ {
        let of_layer = move |layer: &_| Self::of(ProductKind::WeightGradient, rows, layer);
        shape.layers().iter().map(of_layer)
    }

    fn of(kind: ProductKind, rows: usize, layer: &Layer) -> Self {
        Self { kind, rows, inputs: layer.inputs, outputs: layer.outputs }
    }
}

/// The networks of an algorithm, with the shape of its batch.
struct Networks<'a> {
    actor: &'a MlpShape,
    critic: &'a MlpShape,
    batch: BatchShape,
}

impl Cycle {
    /// Lists the products of the learner's networks, without those of the DMP. Empty for on-policy
    /// algorithms, which the benchmark does not support.
    pub(super) fn of(learner: &Learner) -> Self {
        let one_update = |products| Self { products, updates: 1 };
        let Regime::OffPolicy(off_policy) = &learner.regime else { return one_update(Vec::new()) };
        let all = learner.networks();
        let shape = |prefix: &str| {
            let network = all.iter().find(|(name, _)| name.starts_with(prefix));
            &network.expect("every algorithm has an actor and a critic").1.shape
        };
        let batch = off_policy.algorithm.batch_shape();
        let config = &learner.config().algorithm;
        let critic = match config.name {
            // Its critics have no shape of ours: a graph computes them.
            AlgorithmName::Tqc => &MlpShape::new(
                [&[batch.critic_width()], &config.critic_hidden[..], &[config.tqc.quantiles]]
                    .concat(),
            ),
            _ => shape("critic"),
        };
        let networks = Networks { actor: shape("actor"), critic, batch };
        match config.name {
            AlgorithmName::Ddpg => {
                one_update([networks.critics_step(1), networks.actor_step(1)].concat())
            }
            AlgorithmName::Sac => {
                one_update([networks.critics_step(2), networks.actor_step(2)].concat())
            }
            AlgorithmName::Td3 => {
                let updates = config.td3.actor_interval;
                let critics = networks.critics_step(2).repeat(updates as usize);
                Self { products: [critics, networks.actor_step(1)].concat(), updates }
            }
            AlgorithmName::Tqc => {
                let critics = config.tqc.critics;
                one_update([networks.critics_step(critics), networks.actor_step(critics)].concat())
            }
            AlgorithmName::Ndp => one_update(Vec::new()),
        }
    }
}

impl Networks<'_> {
    fn forward(&self, shape: &MlpShape) -> Vec<Product> {
        Product::forward(shape, self.batch.rows).collect()
    }

    /// Returns the products of a forward pass, a backward pass and the parameters' gradient.
    fn training(&self, shape: &MlpShape) -> Vec<Product> {
        let rows = self.batch.rows;
        let passes = Product::forward(shape, rows).chain(Product::backward(shape, rows));
        passes.chain(Product::weight_gradient(shape, rows)).collect()
    }

    /// Returns the products of the critic's forward pass and of its backward pass to the actions.
    fn actions_gradient(&self) -> Vec<Product> {
        let (shape, rows) = (self.critic, self.batch.rows);
        let passes = Product::forward(shape, rows).chain(Product::backward(shape, rows));
        let first = self.batch.observation_len;
        passes.chain([Product::input_gradient(shape, rows, first)]).collect()
    }

    /// Returns the products of a step of the critics: the actor on the next observations, then each
    /// target critic and each critic's training.
    fn critics_step(&self, critics: usize) -> Vec<Product> {
        let each = [self.forward(self.critic), self.training(self.critic)].concat();
        [self.forward(self.actor), each.repeat(critics)].concat()
    }

    /// Returns the products of a step of the actor, with gradients from this many critics.
    fn actor_step(&self, critics: usize) -> Vec<Product> {
        [self.training(self.actor), self.actions_gradient().repeat(critics)].concat()
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::config::Layers;

    use super::*;
    use crate::learner::synthetic::tests::small_spec;

    /// Returns the multiplications and updates of a cycle, with one hidden layer per network and
    /// B = 1.
    fn multiplications(algorithm: &str) -> (usize, u64) {
        let mut layers = Layers::new();
        for (key, value) in [
            ("algorithm.name", algorithm),
            ("policy.kind", "mlp"),
            ("policy.hidden", "[10]"),
            ("algorithm.critic_hidden", "[100]"),
            ("algorithm.batch_size", "1"),
        ] {
            layers.set("test", key, value).unwrap();
        }
        let learner = Learner::new(layers.finish().unwrap(), &small_spec(), 1).unwrap();
        let Cycle { products, updates } = Cycle::of(&learner);
        let count = |product: &Product| product.rows * product.inputs * product.outputs;
        (products.iter().map(count).sum(), updates)
    }

    #[test]
    fn products_match_a_count_by_hand() {
        // Actor 4-10-2 (SAC 4-10-4), critic 6-100-1. The passes are forward, back to the hidden
        // layer, gradient of the weights, and back to the actions, which are 2 of the critic's 6
        // inputs.
        let (forward, back) = (600 + 100, 100);
        let learn = forward + back + (600 + 100);
        let actions_gradient = forward + back + 200;
        let actor = |outputs: usize| (40 + 10 * outputs, 10 * outputs);
        let (actor_forward, actor_back) = actor(2);
        let actor_learn = 2 * actor_forward + actor_back;
        let one = actor_forward + forward + learn;
        assert_eq!(multiplications("ddpg"), (one + actions_gradient + actor_learn, 1));
        let two = actor_forward + 2 * (forward + learn);
        assert_eq!(multiplications("td3"), (2 * two + actions_gradient + actor_learn, 2));
        let (actor_forward, actor_back) = actor(4);
        let two = actor_forward + 2 * (forward + learn);
        let actor_learn = 2 * actor_forward + actor_back;
        assert_eq!(multiplications("sac"), (two + 2 * actions_gradient + actor_learn, 1));
        // TQC has SAC's actor and two critics 6-100-25.
        let (forward, back) = (600 + 2500, 2500);
        let learn = forward + back + (600 + 2500);
        let actions_gradient = forward + back + 200;
        let two = actor_forward + 2 * (forward + learn);
        assert_eq!(multiplications("tqc"), (two + 2 * actions_gradient + actor_learn, 1));
    }
}
