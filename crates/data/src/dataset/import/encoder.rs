//! Makes the episodes of one shard: decodes, resizes and compresses their images.

use std::ops::Range;
use std::sync::atomic::AtomicBool;

use super::recording::{Record, Recording};
use super::skipped::SkippedList;
use super::timing::ImportPlan;
use super::{ImportError, ImportOptions};
use crate::dataset::info::{DatasetInfo, EpisodeData};
use crate::dataset::store::shard::EncodedEpisode;
use foreframe_core::frame::Frame;
use foreframe_core::frame::resize::resize;

/// Images that are decoded in parallel.
const CHUNK_FRAMES: usize = 256;

/// Makes the episodes of a shard.
pub(super) struct EpisodeEncoder<'a> {
    pub(super) plan: &'a ImportPlan,
    pub(super) options: &'a ImportOptions,
    /// The data set's description.
    pub(super) info: &'a DatasetInfo,
    /// The position of the first episode, for messages.
    pub(super) first: usize,
}

/// The episodes of a shard, and what was left out of it.
pub(super) struct EncodedShard {
    pub(super) encoded: Vec<EncodedEpisode>,
    pub(super) bad: SkippedList,
}

impl EpisodeEncoder<'_> {
    /// Reads and compresses the images of some episodes. A damaged image ends its episode if it may be left out. Errors: those of
    /// the images, `Stopped`, `Dataset`.
    pub(super) fn encode(
        &self,
        episodes: Range<usize>,
        cancelled: &AtomicBool,
        on_frames: &dyn Fn(usize),
    ) -> Result<EncodedShard, ImportError> {
        let Recording { records, images, .. } = &self.plan.recording;
        let (mut encoded, mut bad, mut count) = (Vec::new(), SkippedList::default(), 0);
        let resize = |image: &Frame, place: &str| {
            let (width, height) = (self.options.frame_width_px, self.options.frame_height_px);
            resize(image, width, height, self.options.resize).map_err(ImportError::image(place, place))
        };
        for episode in &self.plan.episodes[episodes] {
            let mut data = EpisodeData::default();
            for chunk in episode.chunks(CHUNK_FRAMES) {
                let wanted: Vec<&Record> = chunk.iter().map(|frame| &records[frame.record]).collect();
                let frames = images.read_all(&wanted, &resize, cancelled);
                for ((planned, record), frame) in chunk.iter().zip(wanted).zip(frames) {
                    match frame {
                        Ok(frame) => {
                            data.timestamps_s.push(record.timestamp_s);
                            data.pixels.extend_from_slice(frame.pixels());
                            data.actions.extend_from_slice(&planned.action);
                            data.states.extend_from_slice(&record.state);
                        }
                        Err(error) => {
                            error.leave_out(self.options.skip_bad, &mut bad)?;
                            self.close(&mut data, &mut encoded)?;
                        }
                    }
                }
                count += chunk.len();
                on_frames(count);
            }
            self.close(&mut data, &mut encoded)?;
        }
        Ok(EncodedShard { encoded, bad })
    }

    /// Ends an episode; one of a single frame is of no use and left out. Its times count from its start.
    fn close(&self, data: &mut EpisodeData, encoded: &mut Vec<EncodedEpisode>) -> Result<(), ImportError> {
        let mut data = std::mem::take(data);
        if let [start_s, _, ..] = data.timestamps_s[..] {
            data.timestamps_s.iter_mut().for_each(|time_s| *time_s -= start_s);
            let episode = self.first + encoded.len();
            encoded.push(EncodedEpisode::new(self.info, episode, data)?);
        }
        Ok(())
    }
}
