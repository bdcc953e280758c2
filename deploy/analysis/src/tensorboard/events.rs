//! Writes TensorBoard event files: TFRecords of `tensorflow.Event` messages. The field numbers are
//! those of TensorFlow.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use prost::Message;

/// `SessionLog.SessionStatus` START: readers drop earlier events whose step is not less than that
/// of this event.
const START: i32 = 1;
/// Constant that TFRecord adds to its checksums.
const MASK: u32 = 0xa282_ead8;

/// One record of an event file.
#[derive(Clone, PartialEq, Message)]
struct Event {
    #[prost(double, tag = "1")]
    wall_time: f64,
    #[prost(int64, tag = "2")]
    step: i64,
    #[prost(oneof = "What", tags = "3, 5, 7")]
    what: Option<What>,
}

/// The oneof `what` of `tensorflow.Event`.
#[derive(Clone, PartialEq, prost::Oneof)]
enum What {
    #[prost(string, tag = "3")]
    FileVersion(String),
    #[prost(message, tag = "5")]
    Summary(Summary),
    #[prost(message, tag = "7")]
    SessionLog(SessionLog),
}

#[derive(Clone, PartialEq, Message)]
struct Summary {
    #[prost(message, repeated, tag = "1")]
    value: Vec<Value>,
}

#[derive(Clone, PartialEq, Message)]
struct Value {
    #[prost(string, tag = "1")]
    tag: String,
    #[prost(float, optional, tag = "2")]
    simple_value: Option<f32>,
}

#[derive(Clone, PartialEq, Message)]
struct SessionLog {
    #[prost(int32, tag = "1")]
    status: i32,
}

/// An event file, opened for writing.
pub(super) struct EventFile(BufWriter<File>);

impl EventFile {
    /// Creates a file and writes its header.
    pub(super) fn create(path: &Path, wall_time: f64) -> std::io::Result<Self> {
        let mut file = Self(BufWriter::new(File::create(path)?));
        let version = What::FileVersion("brain.Event:2".into());
        file.write(&Event { wall_time, step: 0, what: Some(version) })?;
        let start = What::SessionLog(SessionLog { status: START });
        file.write(&Event { wall_time, step: 0, what: Some(start) })?;
        Ok(file)
    }

    /// Writes the scalars of a step.
    ///
    /// - `scalars`: tag and value of each.
    pub(super) fn scalars(
        &mut self,
        wall_time: f64,
        step: u64,
        scalars: &[(String, f64)],
    ) -> std::io::Result<()> {
        let value = scalars
            .iter()
            .map(|(tag, number)| Value { tag: tag.clone(), simple_value: Some(*number as f32) });
        let summary = What::Summary(Summary { value: value.collect() });
        let step = i64::try_from(step).unwrap_or(i64::MAX);
        self.write(&Event { wall_time, step, what: Some(summary) })
    }

    pub(super) fn flush(&mut self) -> std::io::Result<()> {
        self.0.flush()
    }

    fn write(&mut self, event: &Event) -> std::io::Result<()> {
        let data = event.encode_to_vec();
        let length = (data.len() as u64).to_le_bytes();
        self.0.write_all(&length)?;
        self.0.write_all(&masked_crc(&length).to_le_bytes())?;
        self.0.write_all(&data)?;
        self.0.write_all(&masked_crc(&data).to_le_bytes())
    }
}

/// Returns the masked CRC-32C of TFRecord.
fn masked_crc(bytes: &[u8]) -> u32 {
    crc32c::crc32c(bytes).rotate_right(15).wrapping_add(MASK)
}

/// Returns (tag, step, number) of every scalar of a file, after verifying the checksums.
#[cfg(test)]
pub(super) fn scalars_of(mut bytes: &[u8]) -> Vec<(String, i64, f32)> {
    let mut scalars = Vec::new();
    while !bytes.is_empty() {
        let (head, rest) = bytes.split_at(12);
        let length = u64::from_le_bytes(head[..8].try_into().unwrap()) as usize;
        assert_eq!(head[8..], masked_crc(&head[..8]).to_le_bytes());
        let (data, rest) = rest.split_at(length);
        assert_eq!(rest[..4], masked_crc(data).to_le_bytes());
        bytes = &rest[4..];
        let event = Event::decode(data).unwrap();
        if let Some(What::Summary(Summary { value })) = event.what {
            let values = value.into_iter().map(|it| (it.tag, event.step, it.simple_value.unwrap()));
            scalars.extend(values);
        }
    }
    scalars
}
