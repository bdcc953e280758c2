//! Records updates on a GPU as CUDA graphs, and repeats them.
//!
//! An update starts hundreds of small operations, and starting one takes longer than the GPU needs
//! for most of them. CUDA starts a recorded update as a whole. Everything that it reads or writes
//! must keep its place in memory, so batch, networks and losses are written in place (`batch`,
//! `network`, `losses`).

use std::collections::BTreeMap;
use std::fmt::{Debug, Formatter};

use candle_core::cuda::cudarc::driver::CudaGraph;
use candle_core::cuda::cudarc::driver::sys::{CUgraphInstantiate_flags, CUstreamCaptureMode};
use candle_core::cuda::{CudaDevice, WrapErr};
use candle_core::{Error, Result};

use super::Graph;
use super::losses::Present;

/// The recorded update of each variant (`GraphAlgorithm::variant`).
#[derive(Debug, Default)]
pub(super) struct Recordings(BTreeMap<u64, Variant>);

#[derive(Debug)]
enum Variant {
    /// Was done once. candle then has its kernels and the sizes of their operands on the GPU, where
    /// it can copy neither while operations are recorded.
    Prepared,
    Recorded(Recording),
}

/// A recorded update.
struct Recording {
    graph: CudaGraph,
    /// The networks that it trains, as indices.
    trained: Vec<usize>,
    present: Present,
}

// SAFETY: CUDA allows the use from any thread, but from one at a time, and all uses have `&mut`
// access to the `Graph` with this recording.
unsafe impl Send for Recording {}
// SAFETY: nothing can be done with `&Recording`, because all its uses are in methods of `Graph`
// that take `&mut self`.
unsafe impl Sync for Recording {}

impl Debug for Recording {
    fn fmt(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Recording").field("trained", &self.trained).finish_non_exhaustive()
    }
}

impl Recordings {
    /// Drops all recordings, because something has moved in memory.
    pub(super) fn forget(&mut self) {
        self.0.clear();
    }
}

impl Graph {
    /// Does an update on a GPU, with the batch that was copied to it. The operations of the first
    /// update of a variant are started one by one, those of the second are recorded.
    pub(super) fn compute_on_gpu(&mut self, gpu: &CudaDevice, variant: u64) -> Result<Present> {
        match self.recordings.0.get(&variant) {
            None => {
                let _cache = gpu.enable_cuda_graph_htod_cache();
                let present = self.compute(variant)?;
                self.recordings.0.insert(variant, Variant::Prepared);
                Ok(present)
            }
            Some(Variant::Prepared) => {
                let recording = self.record(gpu, variant)?;
                recording.graph.launch().w()?;
                let present = recording.present;
                self.recordings.0.insert(variant, Variant::Recorded(recording));
                Ok(present)
            }
            Some(Variant::Recorded(recording)) => {
                recording.graph.launch().w()?;
                recording.trained.iter().for_each(|index| self.networks[*index].step += 1);
                Ok(recording.present)
            }
        }
    }

    /// Records an update without doing it.
    fn record(&mut self, gpu: &CudaDevice, variant: u64) -> Result<Recording> {
        let steps = |graph: &Self| graph.networks.iter().map(|it| it.step).collect::<Vec<_>>();
        let before = steps(self);
        let stream = gpu.cuda_stream();
        let _cache = gpu.enable_cuda_graph_htod_cache();
        stream.begin_capture(CUstreamCaptureMode::CU_STREAM_CAPTURE_MODE_THREAD_LOCAL).w()?;
        let computed = self.compute(variant);
        // Ends the recording even if an operation failed.
        let flags = CUgraphInstantiate_flags::CUDA_GRAPH_INSTANTIATE_FLAG_AUTO_FREE_ON_LAUNCH;
        let graph = stream.end_capture(flags).w();
        let present = computed?;
        let graph = graph?.ok_or_else(|| Error::Msg("the GPU recorded no update".into()))?;
        let changed = before.into_iter().zip(steps(self)).enumerate();
        let trained = changed.filter(|(_, (before, now))| before != now).map(|(index, _)| index);
        Ok(Recording { graph, trained: trained.collect(), present })
    }
}
