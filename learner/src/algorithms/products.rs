//! The matrix products of an update, for its floor: what is left of DDPG, TD3 and SAC when
//! everything else costs nothing. Called by `dmprl bench learner`.

use dmprl_shared::policy::MlpShape;

use super::{Algorithm, Kind};
use crate::update::floor::Product;

/// Products that come back every few updates.
#[derive(Debug, Clone, PartialEq)]
pub struct Cycle {
    /// All of them.
    pub products: Vec<Product>,
    /// Updates that they belong to: TD3's actor moves in some only.
    pub updates: u64,
}

/// The passes of one network over the batch.
struct Network<'a> {
    shape: &'a MlpShape,
    rows: usize,
}

impl Network<'_> {
    fn forward(&self) -> impl Iterator<Item = Product> {
        Product::forward(self.shape, self.rows)
    }

    /// Forward, back, and the gradient of the parameters.
    fn learn(&self) -> impl Iterator<Item = Product> {
        let back = Product::backward(self.shape, self.rows);
        self.forward().chain(back).chain(Product::weight_gradient(self.shape, self.rows))
    }

    /// Forward, and back to the inputs from column `first` on.
    fn see_through(&self, first: usize) -> impl Iterator<Item = Product> {
        let back = Product::backward(self.shape, self.rows);
        self.forward().chain(back).chain([Product::input_gradient(self.shape, self.rows, first)])
    }
}

impl Algorithm {
    /// The products of its updates: of the networks, without the DMP's own. An on-policy algorithm
    /// has none of these: it learns from its rollouts as a whole.
    #[must_use]
    pub fn products(&self) -> Cycle {
        let once = |products| Cycle { products, updates: 1 };
        match &self.kind {
            Kind::Ddpg(_) => once([self.critics_step(1), self.actor_step(1)].concat()),
            Kind::Sac(_) => once([self.critics_step(2), self.actor_step(2)].concat()),
            Kind::Td3(td3) => {
                let updates = td3.config.actor_interval;
                let critics = self.critics_step(2).repeat(updates as usize);
                Cycle { products: [critics, self.actor_step(1)].concat(), updates }
            }
            Kind::Ndp(_) => once(Vec::new()),
        }
    }

    fn actor_passes(&self) -> Network<'_> {
        self.passes("actor")
    }

    fn critic_passes(&self) -> Network<'_> {
        self.passes("critic")
    }

    /// Of the first network whose name begins so.
    fn passes(&self, name: &str) -> Network<'_> {
        let networks = self.networks();
        let found = networks.iter().find(|(of, _)| of.starts_with(name));
        let (_, trained) = found.expect("every algorithm has an actor and a critic");
        Network { shape: &trained.shape, rows: self.shape.rows }
    }

    /// The actor on the next observations; each target, then each critic's regression.
    fn critics_step(&self, critics: usize) -> Vec<Product> {
        let critic = self.critic_passes();
        let of_each = (0..critics).flat_map(|_| critic.forward().chain(critic.learn()));
        self.actor_passes().forward().chain(of_each).collect()
    }

    /// The actor's own step, looking through so many critics.
    fn actor_step(&self, critics: usize) -> Vec<Product> {
        let critic = self.critic_passes();
        let first = self.shape.observation_len;
        let of_each = (0..critics).flat_map(|_| critic.see_through(first));
        self.actor_passes().learn().chain(of_each).collect()
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::config::Layers;
    use dmprl_shared::policy::Policy;

    use super::*;
    use crate::learner::tests::spec;

    /// Multiplications of an update with one hidden layer everywhere, B = 1.
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
        let config = layers.finish().unwrap();
        let policy = Policy::new(&config, &spec()).unwrap();
        let cycle = Algorithm::new(&config, &policy).unwrap().products();
        (cycle.products.iter().map(|it| it.operations() / 2).sum(), cycle.updates)
    }

    #[test]
    fn an_updates_products_are_those_counted_by_hand() {
        // Actor 4-10-2 (SAC 4-10-4), critic 6-100-1. A pass forward, back to the hidden layer, of
        // the weights; and back to the actions, 2 of the critic's 6 inputs.
        let (forward, back) = (600 + 100, 100);
        let learn = forward + back + (600 + 100);
        let see_through = forward + back + 200;
        let actor = |outputs: usize| (40 + 10 * outputs, 10 * outputs);
        let (actor_forward, actor_back) = actor(2);
        let actor_learn = 2 * actor_forward + actor_back;
        let one = actor_forward + forward + learn;
        assert_eq!(multiplications("ddpg"), (one + see_through + actor_learn, 1));
        let two = actor_forward + 2 * (forward + learn);
        assert_eq!(multiplications("td3"), (2 * two + see_through + actor_learn, 2));
        let (actor_forward, actor_back) = actor(4);
        let two = actor_forward + 2 * (forward + learn);
        let actor_learn = 2 * actor_forward + actor_back;
        assert_eq!(multiplications("sac"), (two + 2 * see_through + actor_learn, 1));
    }
}
