//! The ways of several plans, seen from above.

use super::canvas::Canvas;
use foreframe_core::frame::{Frame, FrameError};

/// Side of the picture, in pixels.
const SIDE_PX: usize = 512;
/// The robot stands this far from the lower edge, in pixels.
const BEHIND_PX: f32 = 96.0;
/// Least distance that the picture shows ahead, in metres.
const LEAST_AHEAD_M: f32 = 1.2;
const PAPER: u8 = 255;
const INK: u8 = 0;
const FAINT: u8 = 150;
const GRID: u8 = 225;
const OBSTACLE: u8 = 90;
const MOVER_FIRST: u8 = 225;
const MOVER_LAST: u8 = 130;
/// How thick the best way is drawn, in pixels.
const THICK_PX: f32 = 2.5;

/// What the picture shows: metres ahead and to the left of the robot.
#[derive(Clone, Debug, Default)]
pub struct PlanFan {
    /// The way of each plan, without its start; the best one first.
    pub ways_m: Vec<Vec<[f32; 2]>>,
    /// What stands in the way.
    pub obstacles_m: Vec<[f32; 2]>,
    /// Where movers are now, then after each step.
    pub movers_m: Vec<Vec<[f32; 2]>>,
    /// Where the robot should get.
    pub goal_m: Option<[f32; 2]>,
    /// Radius of the robot.
    pub radius_m: f32,
}

/// The ways from above: ahead is up. The best way is black, the others are gray; squares are what stands in the way, lighter ones
/// movers, the darker the later; a cross is the goal, circles are the robot now and at the end of the best way. The grid's lines are half a metre apart.
/// Errors: those of a frame.
pub fn fan_picture(fan: &PlanFan) -> Result<Frame, FrameError> {
    let places = fan.ways_m.iter().flatten().chain(&fan.goal_m);
    let farthest = places
        .map(|[ahead, left]| ahead.max(left.abs() * 2.0))
        .fold(LEAST_AHEAD_M, f32::max);
    let mut view = FanView {
        px_per_m: (SIDE_PX as f32 - 1.5 * BEHIND_PX) / farthest.min(4.0),
        canvas: Canvas::new(SIDE_PX, SIDE_PX, PAPER),
    };
    view.grid();
    for (step, places) in fan.movers_m.iter().enumerate() {
        let share = (step + 1) as f32 / fan.movers_m.len() as f32;
        let ink = MOVER_FIRST - (share * f32::from(MOVER_FIRST - MOVER_LAST)) as u8;
        for &place in places {
            view.dot(place, 0.025 * view.px_per_m, ink);
        }
    }
    for &place in &fan.obstacles_m {
        view.dot(place, 0.025 * view.px_per_m, OBSTACLE);
    }
    for (index, way) in fan.ways_m.iter().enumerate().rev() {
        let (thickness, ink) = if index == 0 { (THICK_PX, INK) } else { (0.8, FAINT) };
        let mut from = [0.0, 0.0];
        for &to in way {
            view.line(from, to, thickness, ink);
            from = to;
        }
        if index == 0 {
            view.circle(from, fan.radius_m, FAINT);
        }
    }
    view.circle([0.0, 0.0], fan.radius_m, INK);
    if let Some([ahead, left]) = fan.goal_m {
        let arm = 8.0 / view.px_per_m;
        view.line([ahead - arm, left - arm], [ahead + arm, left + arm], 1.5, INK);
        view.line([ahead - arm, left + arm], [ahead + arm, left - arm], 1.5, INK);
    }
    Frame::new(SIDE_PX as u32, SIDE_PX as u32, view.canvas.pixels)
}

struct FanView {
    px_per_m: f32,
    canvas: Canvas,
}

impl FanView {
    fn pixel(&self, [ahead, left]: [f32; 2]) -> [f32; 2] {
        let side = SIDE_PX as f32;
        [
            side / 2.0 - left * self.px_per_m,
            side - BEHIND_PX - ahead * self.px_per_m,
        ]
    }

    /// A filled square, `half_px` to each side.
    fn dot(&mut self, place_m: [f32; 2], half_px: f32, ink: u8) {
        self.canvas.dot(self.pixel(place_m), half_px, ink);
    }

    fn line(&mut self, from_m: [f32; 2], to_m: [f32; 2], half_px: f32, ink: u8) {
        self.canvas.line(self.pixel(from_m), self.pixel(to_m), half_px, ink);
    }

    fn circle(&mut self, [ahead, left]: [f32; 2], radius_m: f32, ink: u8) {
        for step in 0..360 {
            let (sin, cos) = (step as f32).to_radians().sin_cos();
            self.dot([ahead + radius_m * cos, left + radius_m * sin], 0.8, ink);
        }
    }

    fn grid(&mut self) {
        for line in -10..=10 {
            let at = line as f32 * 0.5;
            self.line([-5.0, at], [5.0, at], 0.5, GRID);
            self.line([at, -5.0], [at, 5.0], 0.5, GRID);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_way_is_black_and_goes_up_if_it_goes_ahead() {
        let fan = PlanFan {
            ways_m: vec![vec![[0.3, 0.0], [0.5, 0.0]], vec![[0.3, 0.3]]],
            obstacles_m: vec![[0.5, 0.4]],
            movers_m: vec![vec![[0.8, 0.3]], vec![[0.8, 0.1]]],
            goal_m: Some([0.6, -0.2]),
            radius_m: 0.1,
        };
        let picture = fan_picture(&fan).unwrap();
        let pixel = |[ahead, left]: [f32; 2]| {
            let scale = (SIDE_PX as f32 - 1.5 * BEHIND_PX) / LEAST_AHEAD_M;
            let (x, y) = (256.0 - left * scale, 416.0 - ahead * scale);
            picture.pixels()[y as usize * SIDE_PX + x as usize]
        };
        assert_eq!(
            (pixel([0.25, 0.0]), pixel([0.5, 0.4]), pixel([0.6, -0.2])),
            (INK, OBSTACLE, INK)
        );
        let movers = [pixel([0.8, 0.3]), pixel([0.8, 0.1])];
        assert!(movers[1] == MOVER_LAST && movers[0] > MOVER_LAST, "{movers:?}");
        assert_eq!(pixel([0.42, 0.25]), PAPER);
        let far = PlanFan {
            goal_m: Some([900.0, -900.0]),
            ..PlanFan::default()
        };
        assert!(fan_picture(&far).is_ok());
    }
}
