//! Measures how long a checkpoint delays training, and how long it takes to write.
//!
//!     cargo bench -p dmprl-learner --bench checkpoint [-- --gigabytes 1 --folder DIR]
//!
//! The replay is full of segments with Pusher's sizes. Segments are inserted while the checkpoint
//! is written. The longest insertion is one that copies a chunk of the replay.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use dmprl_learner::checkpoint::Writer;
use dmprl_learner::learner::Learner;
use dmprl_shared::config::Layers;
use dmprl_shared::segment::{LAYOUT_VERSION, Segment, SegmentHeader, block_checksum};
use dmprl_shared::spec::EnvSpec;

fn learner(gigabytes: f64) -> Learner {
    let mut layers = Layers::new();
    let spec = EnvSpec::new("Pusher-v5", 23, &[(-2.0, 2.0); 7], 0.05, 100);
    let sizes = Learner::new(Layers::new().finish().expect("defaults"), &spec, 1);
    let layout = sizes.expect("a learner").policy().layout();
    let segments = (gigabytes * 1e9) as usize / (layout.block_len() * size_of::<f32>());
    let steps = (segments * layout.segment_steps).to_string();
    for (key, value) in [("replay.capacity_steps", steps.as_str()), ("actors.workers", "1")] {
        layers.set("bench", key, value).expect("a known key");
    }
    Learner::new(layers.finish().expect("a configuration"), &spec, 1).expect("a learner")
}

fn segment(learner: &Learner) -> Segment {
    let layout = learner.policy().layout();
    let mut segment = Segment::zeroed(layout);
    segment.block.fill(0.5);
    segment.header = SegmentHeader {
        layout_version: LAYOUT_VERSION,
        run_id: 1,
        architecture_hash: learner.policy().architecture_hash(),
        incarnation: 1,
        steps_len: layout.segment_steps as u32,
        segment_steps: layout.segment_steps as u32,
        observation_len: layout.observation_len as u32,
        action_len: layout.action_len as u32,
        checksum: block_checksum(&segment.block),
        ..SegmentHeader::default()
    };
    segment
}

fn main() {
    let argument = |name: &str| std::env::args().skip_while(|it| it != name).nth(1);
    let gigabytes = argument("--gigabytes").map_or(1.0, |text| text.parse().expect("a number"));
    let folder = argument("--folder").map_or_else(std::env::temp_dir, PathBuf::from);
    let folder = tempfile::tempdir_in(folder).expect("a folder");
    let mut learner = learner(gigabytes);
    let mut segment = segment(&learner);
    let mut insert = |learner: &mut Learner| {
        segment.header.sequence += 1;
        segment.header.episode = segment.header.sequence as u32;
        let begun = Instant::now();
        learner.insert(&segment).expect("a sound segment");
        begun.elapsed()
    };
    let ms = |time: Duration| 1e3 * time.as_secs_f64();
    while learner.replay.len() < learner.replay.capacity() {
        insert(&mut learner);
    }
    let mut writer = Writer::new(folder.path().to_owned());
    for _ in 0..5 {
        let begun = Instant::now();
        writer.begin(&mut learner).expect("a checkpoint");
        let stall = begun.elapsed();
        let mut longest = Duration::ZERO;
        let outcome = loop {
            longest = longest.max(insert(&mut learner));
            if let Some(outcome) = writer.poll(&mut learner) {
                break outcome;
            }
            // About the rate of a fast run. A much higher rate would copy the whole replay.
            std::thread::sleep(Duration::from_micros(200));
        };
        outcome.result.expect("a checkpoint");
        println!(
            "training waits {:.1} ms; written after {:.0} ms; longest insertion meanwhile {:.2} ms",
            ms(stall),
            ms(begun.elapsed()),
            ms(longest)
        );
    }
}
