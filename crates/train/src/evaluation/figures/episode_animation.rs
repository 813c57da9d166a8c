//! A driven episode as a GIF: what the camera shows, beside the room from above.

use std::collections::VecDeque;

use super::canvas::{Canvas, TextStyle, height_px};
use super::montage::enlarged;
use crate::evaluation::drive::{DriveError, DriveSettings, DriveStep, DriverKind, replay};
use foreframe_core::frame::{Frame, FrameError, codec};
use foreframe_core::registry::Model;
use foreframe_sim::{PlanarPose, World};

const PAPER: u8 = 255;
const INK: u8 = 0;
const GAP_PX: usize = 8;
const LETTER_SCALE: usize = 2;
const TEXT: TextStyle = TextStyle {
    scale: LETTER_SCALE,
    ink: INK,
};
/// A line of the caption and the gap below it.
const LINE_PX: usize = height_px(LETTER_SCALE) + 4;
/// Driver, episode, time, collision.
const CAPTION_LINES: usize = 4;
/// Walls and pieces from above.
const WALL: u8 = 150;
const ROBOT: u8 = 205;
const TRACK: u8 = 170;
/// The plan in the camera's picture: white between black edges.
const PLAN_IN_PICTURE: u8 = 255;
/// Points of a way are not farther apart than this when the camera's picture shows it, in metres.
const FINE_M: f32 = 0.02;
/// A larger file, in bytes, gets fewer gray values.
const LARGE_BYTES: usize = 1_500_000;
/// From one gray value to the next: what is tried until the file is not large.
const GRAY_STEPS: [u8; 4] = [8, 16, 32, 64];
/// The most pictures in a GIF: half a minute at five steps a second. Of a longer episode, the end is shown.
const MAX_PICTURES: usize = 150;

/// Drives an episode once more, and draws each step: on the left what the camera shows, with the way of the plan on the floor and the
/// robot's circle at its end; on the right the room from above with walls and pieces (dark gray), all robots, the goal (a cross), the way
/// driven so far and the plan (thick). Without a budget for plans, it is the same episode as in [`super::super::drive::run`].
/// Of an episode of more than half a minute, its end is shown.
/// Errors: as [`replay`].
pub fn episode_gif(
    model: Option<&Model>,
    settings: &DriveSettings,
    driver: DriverKind,
    episode: usize,
) -> Result<Vec<u8>, DriveError> {
    let mut pictures = VecDeque::new();
    let mut period_s = 0.0;
    let mut view: Option<RoomView> = None;
    replay(model, settings, driver, episode, &mut |step| {
        let picture = camera_picture(step)?;
        let side = picture.height() as usize + CAPTION_LINES * LINE_PX;
        let view = view.get_or_insert_with(|| RoomView::new(step.world, side));
        let captions = [
            driver.name().to_owned(),
            format!("episode {episode}"),
            format!("{:.1} s", step.world.observe().time_s),
            String::from(if step.world.touch().is_some() { "collision" } else { "" }),
        ];
        if pictures.len() == MAX_PICTURES {
            pictures.pop_front();
        }
        pictures.push_back(joined(&picture, &captions, &view.draw(step)?)?);
        period_s = f64::from(step.period_s);
        Ok(())
    })?;
    Ok(small_gif(&Vec::from(pictures), period_s, LARGE_BYTES)?)
}

/// A GIF with as many gray values as the size limit allows. If even the fewest are too large, it exceeds the limit.
fn small_gif(pictures: &[Frame], period_s: f64, large_bytes: usize) -> Result<Vec<u8>, FrameError> {
    let mut gif = Vec::new();
    for gray_step in GRAY_STEPS {
        let coarse: Vec<Frame> = pictures
            .iter()
            .map(|picture| coarser(picture, gray_step))
            .collect::<Result<_, _>>()?;
        gif = codec::encode_gif(&coarse, period_s)?;
        if gif.len() <= large_bytes {
            break;
        }
    }
    Ok(gif)
}

/// The picture with fewer gray values; black and white stay.
fn coarser(picture: &Frame, gray_step: u8) -> Result<Frame, FrameError> {
    let most = u16::from(u8::MAX / gray_step);
    let values = picture.pixels().iter();
    let values = values.map(|value| (u16::from(value / gray_step) * 255 / most) as u8);
    Frame::new(picture.width(), picture.height(), values.collect())
}

/// The camera's picture with the captions below it, and the room beside them.
fn joined(picture: &Frame, captions: &[String], room: &Frame) -> Result<Frame, FrameError> {
    let left = picture.width() as usize + 2 * GAP_PX;
    let width = left + room.width() as usize + GAP_PX;
    let height = room.height() as usize + 2 * GAP_PX;
    let mut canvas = Canvas::new(width, height, PAPER);
    canvas.paste(picture, [GAP_PX; 2]);
    canvas.paste(room, [left, GAP_PX]);
    let first = GAP_PX + picture.height() as usize + 4;
    for (line, caption) in captions.iter().enumerate() {
        canvas.write(GAP_PX, first + line * LINE_PX, caption, TEXT);
    }
    Frame::new(width as u32, height as u32, canvas.pixels)
}

/// What the camera shows, enlarged, with the plan.
fn camera_picture(step: &DriveStep<'_>) -> Result<Frame, FrameError> {
    let seen = step.world.observe().frame;
    let picture = enlarged(&seen)?;
    let [width, height] = [picture.width(), picture.height()];
    let scale = width as f32 / seen.width() as f32;
    let mut canvas = Canvas::new(width as usize, height as usize, PAPER);
    canvas.paste(&picture, [0, 0]);
    let (way, end) = marks_on_floor(step);
    for (half_px, ink) in [(3.0, INK), (1.5, PLAN_IN_PICTURE)] {
        for points_m in [&way, &end] {
            let places = on_picture(step.world, points_m, scale);
            for pair in places.windows(2) {
                if let [Some(from), Some(to)] = *pair {
                    canvas.line(from, to, half_px, ink);
                }
            }
        }
    }
    Frame::new(width, height, canvas.pixels)
}

/// The way of the plan from the robot on, and the robot's circle at its end, in the room. Both are empty without a plan.
fn marks_on_floor(step: &DriveStep<'_>) -> (Vec<[f32; 2]>, Vec<[f32; 2]>) {
    let Some(&end) = step.plan_m.last() else {
        return (Vec::new(), Vec::new());
    };
    let mut way = vec![position(step.world.observer_pose())];
    for &to in step.plan_m {
        let from = way.last().copied().unwrap_or(to);
        let parts = ((to[0] - from[0]).hypot(to[1] - from[1]) / FINE_M).ceil().max(1.0);
        let points = (1..=parts as usize).map(|part| between(from, to, part as f32 / parts));
        way.extend(points);
    }
    (way, circle(end, step.world.observer_radius_m()))
}

/// Places [column, row] of points of the floor in the enlarged picture; `None` for those far outside it, and behind the camera.
fn on_picture(world: &World, points_m: &[[f32; 2]], scale: f32) -> Vec<Option<[f32; 2]>> {
    let camera = world.camera();
    let far = 2.0 * world.observe().frame.width().max(world.observe().frame.height()) as f32;
    let project = |&[x, y]: &[f32; 2]| {
        let place = camera.project([x, y, 0.0])?;
        let is_near = place.iter().all(|part| part.abs() < far);
        is_near.then(|| place.map(|part| part * scale))
    };
    points_m.iter().map(project).collect()
}

/// The room from above: x is up, y to the left.
struct RoomView {
    empty: Canvas,
    /// Length and width of the room.
    sides_m: [f32; 2],
    side_px: usize,
    px_per_m: f32,
    track_m: Vec<[f32; 2]>,
}

impl RoomView {
    /// A square picture with walls and pieces.
    fn new(world: &World, side_px: usize) -> Self {
        let sides_m = world.room_sides_m();
        let mut view = Self {
            empty: Canvas::new(side_px, side_px, WALL),
            sides_m,
            side_px,
            px_per_m: (side_px as f32 - 8.0) / sides_m[0].max(sides_m[1]),
            track_m: Vec::new(),
        };
        for row in 0..side_px {
            for column in 0..side_px {
                if !world.is_blocked(view.place_m([column as f32, row as f32])) {
                    view.empty.set(column, row, PAPER);
                }
            }
        }
        view
    }

    fn pixel(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        let middle = self.side_px as f32 / 2.0;
        [
            middle - y * self.px_per_m,
            middle + (self.sides_m[0] / 2.0 - x) * self.px_per_m,
        ]
    }

    fn place_m(&self, [column, row]: [f32; 2]) -> [f32; 2] {
        let middle = self.side_px as f32 / 2.0;
        [
            self.sides_m[0] / 2.0 - (row - middle) / self.px_per_m,
            (middle - column) / self.px_per_m,
        ]
    }

    fn draw(&mut self, step: &DriveStep<'_>) -> Result<Frame, FrameError> {
        let pose = step.world.observer_pose();
        self.track_m.push(position(pose));
        let mut canvas = self.empty.clone();
        for (index, other) in step.world.other_robot_poses().into_iter().enumerate() {
            let radius_m = step.world.other_robot_radius_m(index);
            canvas.disc(self.pixel(position(other)), radius_m * self.px_per_m, ROBOT);
            self.robot(&mut canvas, other, radius_m, 0.5);
        }
        self.lines(&mut canvas, &self.track_m, (1.0, TRACK));
        self.robot(&mut canvas, pose, step.world.observer_radius_m(), 1.0);
        let (way, end) = marks_on_floor(step);
        self.lines(&mut canvas, &way, (1.5, INK));
        self.lines(&mut canvas, &end, (0.5, TRACK));
        let [x, y] = self.pixel(step.goal_m);
        for sign in [-1.0, 1.0] {
            canvas.line([x - 6.0, y - 6.0 * sign], [x + 6.0, y + 6.0 * sign], 1.0, INK);
        }
        Frame::new(self.side_px as u32, self.side_px as u32, canvas.pixels)
    }

    /// A circle with a line from its middle to where the robot looks.
    fn robot(&self, canvas: &mut Canvas, pose: PlanarPose, radius_m: f32, half_px: f32) {
        let (sin, cos) = pose.heading_rad.sin_cos();
        let front = [pose.x_m + radius_m * cos, pose.y_m + radius_m * sin];
        self.lines(canvas, &circle(position(pose), radius_m), (half_px, INK));
        self.lines(canvas, &[position(pose), front], (half_px, INK));
    }

    fn lines(&self, canvas: &mut Canvas, points_m: &[[f32; 2]], (half_px, ink): (f32, u8)) {
        for pair in points_m.windows(2) {
            if let &[from, to] = pair {
                canvas.line(self.pixel(from), self.pixel(to), half_px, ink);
            }
        }
    }
}

fn position(pose: PlanarPose) -> [f32; 2] {
    [pose.x_m, pose.y_m]
}

fn between(from: [f32; 2], to: [f32; 2], part: f32) -> [f32; 2] {
    [0, 1].map(|axis| from[axis] + part * (to[axis] - from[axis]))
}

/// Points on a closed circle.
fn circle([x, y]: [f32; 2], radius_m: f32) -> Vec<[f32; 2]> {
    let point = |step: u16| {
        let (sin, cos) = f32::from(step * 10).to_radians().sin_cos();
        [x + radius_m * cos, y + radius_m * sin]
    };
    (0..=36).map(point).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use foreframe_core::types::Seed;
    use foreframe_sim::{Scenario, WorldConfig};

    fn world() -> World {
        World::new(Scenario::MovingObserver, &WorldConfig::default(), Seed(3), 1).unwrap()
    }

    fn ahead(pose: PlanarPose, distance_m: f32) -> [f32; 2] {
        let (sin, cos) = pose.heading_rad.sin_cos();
        [pose.x_m + distance_m * cos, pose.y_m + distance_m * sin]
    }

    #[test]
    fn a_straight_plan_lies_in_the_lower_middle_of_the_picture() {
        let world = world();
        let plan = [0.3, 0.6, 0.9].map(|distance| ahead(world.observer_pose(), distance));
        let step = DriveStep {
            world: &world,
            goal_m: plan[2],
            plan_m: &plan,
            period_s: 0.2,
        };
        let [width, height] = [world.observe().frame.width(), world.observe().frame.height()].map(|side| side as f32);
        let (way, _) = marks_on_floor(&step);
        let places: Vec<[f32; 2]> = on_picture(&world, &way, 1.0).into_iter().flatten().collect();
        let inside: Vec<_> = places.iter().filter(|place| place[1] < height).collect();
        assert!(inside.len() > 10, "{places:?}");
        for [column, row] in &inside {
            assert!((column - width / 2.0).abs() < 0.5 && *row > height / 2.0, "{inside:?}");
        }
        // What is farther away is higher.
        assert!(inside.windows(2).all(|pair| pair[1][1] < pair[0][1]), "{inside:?}");
        let behind = on_picture(&world, &[ahead(world.observer_pose(), -1.0)], 1.0);
        assert_eq!(behind, [None]);
        // The picture with the plan differs from the one without only there.
        let without = camera_picture(&DriveStep { plan_m: &[], ..step }).unwrap();
        let with = camera_picture(&step).unwrap();
        let changed = |rows: std::ops::Range<usize>| {
            let side = with.width() as usize;
            let range = rows.start * side..rows.end * side;
            with.pixels()[range.clone()] != without.pixels()[range]
        };
        let rows = with.height() as usize;
        assert!(!changed(0..rows / 2) && changed(rows / 2..rows));
    }

    #[test]
    fn a_large_file_gets_fewer_gray_values() {
        let noise = (0..64 * 64u32).map(|pixel| (pixel.wrapping_mul(2_654_435_761) >> 24) as u8);
        let pictures = [Frame::new(64, 64, noise.collect()).unwrap()];
        let fine = small_gif(&pictures, 0.2, LARGE_BYTES).unwrap();
        let coarse = small_gif(&pictures, 0.2, fine.len() - 1).unwrap();
        assert!(coarse.len() < fine.len());
        assert_eq!(small_gif(&pictures, 0.2, fine.len()).unwrap(), fine);
        let gray = Frame::new(4, 1, vec![0, 63, 192, 255]).unwrap();
        assert_eq!(coarser(&gray, 64).unwrap().pixels(), [0, 0, 255, 255]);
        assert_eq!(coarser(&gray, 8).unwrap().pixels(), [0, 57, 197, 255]);
    }

    #[test]
    fn the_room_from_above_shows_walls_robots_goal_and_plan() {
        let world = world();
        let pose = world.observer_pose();
        let plan = [0.3, 0.6].map(|distance| ahead(pose, distance));
        let goal_m = ahead(pose, 1.2);
        let mut view = RoomView::new(&world, 320);
        let picture = view
            .draw(&DriveStep {
                world: &world,
                goal_m,
                plan_m: &plan,
                period_s: 0.2,
            })
            .unwrap();
        let at = |place_m: [f32; 2]| {
            let [column, row] = view.pixel(place_m).map(|part| part.round() as usize);
            picture.pixels()[row * 320 + column]
        };
        assert_eq!((at(goal_m), at(plan[0]), at(plan[1])), (INK, INK, INK));
        let pillar = foreframe_sim::arena::PILLARS[0].position_m;
        assert_eq!((at(pillar), at([-0.02, 0.0])), (WALL, WALL));
        let other = world.other_robot_poses()[0];
        assert_eq!(at(ahead(other, -0.5 * world.other_robot_radius_m(0))), ROBOT);
        let place = view.place_m(view.pixel(goal_m));
        assert!((place[0] - goal_m[0]).abs() < 1e-4 && (place[1] - goal_m[1]).abs() < 1e-4);
    }
}
