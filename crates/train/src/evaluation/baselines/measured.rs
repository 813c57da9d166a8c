//! Scores of the baselines in rooms that differ, for a look. Run with `--ignored --nocapture`.
use std::sync::atomic::AtomicBool;

use rayon::prelude::*;

use super::*;
use crate::evaluation::windows::true_frame;
use foreframe_core::frame::quality::{mse, ssim};
use foreframe_core::types::Seed;
use foreframe_data::dataset::{CollectConfig, Window, collect};
use foreframe_sim::{RoomSet, Scenario};

const SHAPE: WindowShape = WindowShape { context: 5, horizon: 5 };

fn data(rooms: Option<RoomSet>, seed: u64) -> Dataset {
    let out = std::path::PathBuf::from(format!("/tmp/geom-data/{rooms:?}-{seed}"));
    let mut config = CollectConfig::new(Scenario::MovingObserver, 30, Seed(seed), &out);
    config.world.rooms = rooms;
    collect(&config, &|_| {}, &AtomicBool::new(false)).unwrap();
    Dataset::open(&out).unwrap()
}

#[test]
#[ignore = "a measurement"]
fn rooms_measured() {
    for rooms in [Some(RoomSet::Varied), None]
        .into_iter()
        .take(if std::env::var("ONE").is_ok() { 1 } else { 2 })
    {
        let (train, test) = (
            data(rooms, 1),
            data(rooms, std::env::var("SEED").map_or(2, |s| s.parse().unwrap())),
        );
        let splits = Splits::new(&train, Seed(1));
        let baselines = Baselines::fit(&train, &splits, SHAPE, 100).unwrap();
        println!("{rooms:?}");
        let windows: Vec<Window> = test
            .episodes()
            .iter()
            .flat_map(|episode| {
                let starts = (0..(episode.frame_count + 1).saturating_sub(10)).step_by(2);
                starts.map(|start| Window {
                    episode: episode.index,
                    first_frame: episode.first_frame + start,
                })
            })
            .collect();
        println!("{} windows", windows.len());
        for method in [
            Method::CopyLast,
            Method::EgoMotion,
            Method::GroundAndWall,
            Method::PlaneSweep,
        ] {
            let start = std::time::Instant::now();
            let scores: Vec<[f64; 2]> = windows
                .par_iter()
                .map(|&window| {
                    let inputs: Vec<Vec<f32>> = (0..5)
                        .map(|s| true_frame(&test, window.first_frame + s).unwrap())
                        .collect();
                    let input = BaselineInput::of_window(&test, window, SHAPE, &inputs);
                    let predicted = baselines.predict(&test, method, &input, 5).unwrap();
                    let mut sums = [0.0; 2];
                    for (step, predicted) in predicted.iter().enumerate() {
                        let truth = true_frame(&test, window.first_frame + 5 + step).unwrap();
                        sums[0] += mse(predicted, &truth) / 5.0;
                        sums[1] += ssim(predicted, &truth, 64) / 5.0;
                    }
                    sums
                })
                .collect();
            let n = scores.len() as f64;
            println!(
                "{:24} {:7.2} {:.4}  {:.1} s",
                method.label(),
                1e4 * scores.iter().map(|s| s[0]).sum::<f64>() / n,
                scores.iter().map(|s| s[1]).sum::<f64>() / n,
                start.elapsed().as_secs_f32()
            );
        }
    }
}
