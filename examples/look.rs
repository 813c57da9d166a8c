//! Saves a contact sheet of a scenario: one trial a row, every third frame, magnified.
//!
//! `cargo run --release --example look -- moving-observer sheet.png [trials] [columns] [magnification]`
#![allow(missing_docs)]

use std::error::Error;

use foreframe::images::encode_png;
use foreframe::sim::{Scenario, World, WorldConfig};
use foreframe::{Frame, Seed};

const EVERY: usize = 3;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [scenario, path, counts @ ..] = arguments.as_slice() else {
        return Err("usage: look SCENARIO FILE.png [TRIALS] [COLUMNS] [MAGNIFICATION]".into());
    };
    let scenario: Scenario = scenario.parse()?;
    let count = |index: usize, otherwise: usize| counts.get(index).map_or(Ok(otherwise), |text| text.parse());
    let (trials, columns, scale) = (count(0, 5)?, count(1, 8)?, count(2, 3)?);
    let config = WorldConfig::default();
    let side = config.frame_width_px as usize * scale;
    let width = columns * side;
    let mut sheet = vec![0u8; width * trials * side];
    for trial in 0..trials {
        let mut world = World::new(scenario, &config, Seed(1), trial as u64)?;
        for column in 0..columns {
            paste(
                &world.observe().frame,
                &mut sheet,
                [trial * side, column * side, width],
                scale,
            );
            for _ in 0..EVERY {
                let action = world.policy_action();
                let _ended = world.step(&action);
            }
        }
    }
    std::fs::write(
        path,
        encode_png(&Frame::new(width as u32, (trials * side) as u32, sheet)?)?,
    )?;
    Ok(())
}

fn paste(frame: &Frame, sheet: &mut [u8], [top, left, width]: [usize; 3], scale: usize) {
    let columns = frame.width() as usize;
    for (index, &value) in frame.pixels().iter().enumerate() {
        let (row, column) = (index / columns, index % columns);
        for y in 0..scale {
            let begin = (top + row * scale + y) * width + left + column * scale;
            sheet[begin..begin + scale].fill(value);
        }
    }
}
