//! Builds an ONNX graph operation by operation. Values are referenced by name.

use super::onnx_format::{
    ATTRIBUTE_INT, ATTRIBUTE_INTS, AttributeProto, Dimension, DimensionProto, FLOAT, GraphProto,
    INT64, NodeProto, TensorProto, TensorShapeProto, TensorTypeProto, TypeProto, ValueInfoProto,
};

/// Name of the first axis of inputs and outputs, whose length is variable.
const BATCH: &str = "batch";

/// A graph under construction.
#[derive(Debug, Default)]
pub(super) struct Graph(GraphProto);

impl Graph {
    pub(super) fn new(name: &str) -> Self {
        Self(GraphProto { name: name.to_owned(), ..GraphProto::default() })
    }

    pub(super) fn finish(self) -> GraphProto {
        self.0
    }

    /// Adds an input of shape (batch, len).
    pub(super) fn input(&mut self, name: &str, len: usize, about: &str) -> String {
        self.0.input.push(value(name, &[len], about));
        name.to_owned()
    }

    /// Declares `from` as the output `name` of shape (batch, …`shape`).
    pub(super) fn output(&mut self, from: &str, name: &str, shape: &[usize], about: &str) {
        self.0.output.push(value(name, shape, about));
        self.0.node.push(NodeProto {
            input: vec![from.to_owned()],
            output: vec![name.to_owned()],
            name: name.to_owned(),
            op_type: "Identity".into(),
            attribute: Vec::new(),
        });
    }

    /// Adds an operation with one output; returns the output's name.
    pub(super) fn op(&mut self, op: &str, inputs: &[&str]) -> String {
        self.op_with(op, inputs, Vec::new())
    }

    /// Like [`Self::op`], with attributes.
    pub(super) fn op_with(
        &mut self,
        op: &str,
        inputs: &[&str],
        attributes: Vec<AttributeProto>,
    ) -> String {
        let name = format!("{}_{}", op.to_lowercase(), self.0.node.len());
        self.0.node.push(NodeProto {
            input: inputs.iter().map(|&input| input.to_owned()).collect(),
            output: vec![name.clone()],
            name: name.clone(),
            op_type: op.to_owned(),
            attribute: attributes,
        });
        name
    }

    /// Adds a constant tensor.
    pub(super) fn constant(&mut self, shape: &[usize], numbers: &[f32]) -> String {
        let bytes = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
        self.tensor(FLOAT, shape, bytes)
    }

    /// Adds a constant scalar.
    pub(super) fn scalar(&mut self, number: f32) -> String {
        self.constant(&[], &[number])
    }

    fn integers(&mut self, numbers: &[i64]) -> String {
        let bytes = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
        self.tensor(INT64, &[numbers.len()], bytes)
    }

    fn tensor(&mut self, data_type: i32, shape: &[usize], raw_data: Vec<u8>) -> String {
        let name = format!("constant_{}", self.0.initializer.len());
        let dims = shape.iter().map(|&len| len as i64).collect();
        self.0.initializer.push(TensorProto { dims, data_type, name: name.clone(), raw_data });
        name
    }

    /// Selects the entries `begin..end` of an axis.
    pub(super) fn slice(&mut self, from: &str, axis: i64, begin: usize, end: usize) -> String {
        let parts = [begin as i64, end as i64, axis].map(|number| self.integers(&[number]));
        let [begin, end, axis] = &parts;
        self.op("Slice", &[from, begin, end, axis])
    }

    /// Selects the entries `indices` of axis 1.
    pub(super) fn gather(&mut self, from: &str, indices: &[usize]) -> String {
        let indices: Vec<i64> = indices.iter().map(|&index| index as i64).collect();
        let indices = self.integers(&indices);
        self.op_with("Gather", &[from, &indices], vec![int("axis", 1)])
    }

    /// Reshapes a value; an axis of -1 is inferred.
    pub(super) fn reshape(&mut self, from: &str, shape: &[i64]) -> String {
        let shape = self.integers(shape);
        self.op("Reshape", &[from, &shape])
    }

    pub(super) fn concat(&mut self, parts: &[&str], axis: i64) -> String {
        self.op_with("Concat", parts, vec![int("axis", axis)])
    }
}

pub(super) fn int(name: &str, i: i64) -> AttributeProto {
    AttributeProto { name: name.to_owned(), i, ints: Vec::new(), r#type: ATTRIBUTE_INT }
}

pub(super) fn ints(name: &str, ints: &[i64]) -> AttributeProto {
    AttributeProto { name: name.to_owned(), i: 0, ints: ints.to_vec(), r#type: ATTRIBUTE_INTS }
}

fn value(name: &str, shape: &[usize], about: &str) -> ValueInfoProto {
    let batch = Dimension::Name(BATCH.to_owned());
    let rest = shape.iter().map(|&len| Dimension::Value(len as i64));
    let dim = std::iter::once(batch).chain(rest).map(|value| DimensionProto { value: Some(value) });
    let shape = Some(TensorShapeProto { dim: dim.collect() });
    let tensor_type = Some(TensorTypeProto { elem_type: FLOAT, shape });
    let r#type = Some(TypeProto { tensor_type });
    ValueInfoProto { name: name.to_owned(), r#type, doc_string: about.to_owned() }
}
