//! Small changes to valid inputs.

use dmprl_shared::seeds::Stream;
use rand::RngExt;
use serde_json::Value;

/// Numbers that often break counts, lengths and indices.
const EDGES: [u64; 14] = [
    0,
    1,
    2,
    7,
    127,
    255,
    65_535,
    i32::MAX as u64,
    u32::MAX as u64 - 1,
    u32::MAX as u64,
    1 << 33,
    i64::MAX as u64,
    u64::MAX - 1,
    u64::MAX,
];
/// Maximum number of changes to an input.
const CHANGES_MAX: usize = 4;
/// Maximum number of bytes inserted or repeated at once.
const PIECE_MAX: usize = 64;

/// Random choices from one seed.
pub struct Random(Stream);

impl Random {
    pub fn new(stream: Stream) -> Self {
        Self(stream)
    }

    /// Below `limit`; 0 if `limit` is 0.
    pub fn below(&mut self, limit: usize) -> usize {
        if limit == 0 { 0 } else { self.0.random_range(0..limit) }
    }

    /// True once in `n`.
    pub fn once_in(&mut self, n: usize) -> bool {
        self.below(n) == 0
    }

    pub fn pick<'a, T>(&mut self, from: &'a [T]) -> &'a T {
        &from[self.below(from.len())]
    }

    /// An edge value, a value next to one, or any value.
    pub fn number(&mut self) -> u64 {
        match self.below(4) {
            0 => self.0.random(),
            1 => self.pick(&EDGES).wrapping_add(self.below(5) as u64).wrapping_sub(2),
            2 => self.below(300) as u64,
            _ => *self.pick(&EDGES),
        }
    }

    /// In [-1, 1].
    pub fn unit(&mut self) -> f32 {
        self.0.random_range(-1.0..=1.0)
    }

    /// A problematic float, or a usual one.
    pub fn float(&mut self) -> f32 {
        match self.below(3) {
            0 => self.unit(),
            1 => f32::from_bits(self.0.random()),
            _ => *self.pick(&[f32::NAN, f32::INFINITY, -f32::INFINITY, 1.0 + f32::EPSILON, -0.0]),
        }
    }
}

/// Changes bytes in one to [`CHANGES_MAX`] places; `other` is a valid input to splice with.
pub fn bytes(random: &mut Random, input: &mut Vec<u8>, other: &[u8]) {
    for _ in 0..=random.below(CHANGES_MAX) {
        let at = random.below(input.len());
        let end = (at + 1 + random.below(PIECE_MAX)).min(input.len());
        match random.below(9) {
            _ if input.is_empty() => input.extend_from_slice(other),
            0 => input[at] ^= 1 << random.below(8),
            1 => input[at] = random.number() as u8,
            2 => input.truncate(at),
            3 => drop(input.drain(at..end)),
            4 => {
                let piece = input[at..end].to_vec();
                let to = random.below(input.len());
                input.splice(to..to, piece);
            }
            5 => {
                input.truncate(at);
                input.extend_from_slice(&other[at.min(other.len())..]);
            }
            6 => overwrite(random, input, at & !3, 4),
            7 => overwrite(random, input, at & !7, 8),
            _ => input.extend((0..random.below(PIECE_MAX)).map(|_| 0xa5)),
        }
    }
}

fn overwrite(random: &mut Random, input: &mut [u8], at: usize, len: usize) {
    let number = random.number().to_le_bytes();
    for (byte, new) in input.iter_mut().skip(at).zip(&number[..len]) {
        *byte = *new;
    }
}

/// Changes one to [`CHANGES_MAX`] values of a JSON tree.
pub fn json(random: &mut Random, tree: &mut Value) {
    for _ in 0..=random.below(CHANGES_MAX) {
        change(random, tree);
    }
}

/// Descends to a random value and changes it or its container.
fn change(random: &mut Random, tree: &mut Value) {
    let stays = random.once_in(8);
    match tree {
        Value::Object(fields) if !fields.is_empty() && !stays => {
            let name = fields.keys().nth(random.below(fields.len())).cloned().unwrap();
            match random.below(12) {
                0 => drop(fields.remove(&name)),
                1 => drop(fields.insert(format!("{name}_"), Value::from(1))),
                _ => change(random, fields.get_mut(&name).unwrap()),
            }
        }
        Value::Array(values) if !values.is_empty() && !stays => {
            let at = random.below(values.len());
            match random.below(6) {
                0 => drop(values.remove(at)),
                1 => values.insert(at, values[at].clone()),
                _ => change(random, &mut values[at]),
            }
        }
        value => *value = leaf(random),
    }
}

fn leaf(random: &mut Random) -> Value {
    match random.below(8) {
        0 => Value::Null,
        1 => Value::from(-1),
        2 => Value::from(random.below(2) == 0),
        3 => Value::from(""),
        4 => Value::from(f64::from(random.unit()) * 1e300),
        5 => Value::from(vec![0; random.below(40)]),
        _ => Value::from(random.number()),
    }
}
