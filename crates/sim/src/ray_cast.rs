//! Solids for ray casting: an upright cylinder in closed form, which parry does not have or computes more slowly, and a box
//! at any position.

use rapier3d::parry::query::{Ray, RayCast, RayIntersection};
use rapier3d::parry::shape::{Cuboid, FeatureId};
use rapier3d::prelude::Vector;

/// A cylinder around the z axis. parry's own cylinder lies along y and is computed by iteration.
#[derive(Clone, Copy, Debug)]
pub(super) struct UprightCylinder {
    pub(super) radius: f32,
    pub(super) bottom: f32,
    pub(super) top: f32,
}

/// The interval of ray time inside a solid, with the faces where it starts and ends: 0 = side, 1 = top, 2 = bottom.
type Span = [(f32, u32); 2];

impl UprightCylinder {
    /// The interval of ray time inside the cylinder, or none if the ray misses it.
    #[inline]
    fn span(&self, ray: &Ray) -> Option<Span> {
        let (o, d) = (ray.origin, ray.dir);
        let outside = o.x * o.x + o.y * o.y - self.radius * self.radius;
        let a = d.x * d.x + d.y * d.y;
        let b = o.x * d.x + o.y * d.y;
        let under_root = b * b - a * outside;
        // Most rays return here: they miss the cylinder, or lead away from it.
        if under_root < 0.0 || (outside > 0.0 && b >= 0.0) {
            return None;
        }
        let (enter, exit) = if a == 0.0 {
            (f32::NEG_INFINITY, f32::INFINITY)
        } else {
            let root = under_root.sqrt();
            ((-b - root) / a, (-b + root) / a)
        };
        let slab = if d.z == 0.0 {
            let within = (self.bottom..=self.top).contains(&o.z);
            within.then_some([(f32::NEG_INFINITY, 1), (f32::INFINITY, 2)])?
        } else {
            let (bottom, top) = ((self.bottom - o.z) / d.z, (self.top - o.z) / d.z);
            if d.z > 0.0 {
                [(bottom, 2), (top, 1)]
            } else {
                [(top, 1), (bottom, 2)]
            }
        };
        let first = if enter > slab[0].0 { (enter, 0) } else { slab[0] };
        let last = if exit < slab[1].0 { (exit, 0) } else { slab[1] };
        (first.0 <= last.0 && last.0 >= 0.0).then_some([first, last])
    }

    /// Where the ray enters the cylinder, until `max_time`; at its origin, without a normal, if that is inside.
    #[inline]
    pub(super) fn cast(&self, ray: &Ray, max_time: f32) -> Option<RayIntersection> {
        let [(enter, face), _] = self.span(ray)?;
        let (time, outward) = if enter >= 0.0 { (enter, 1.0) } else { (0.0, 0.0) };
        if time > max_time {
            return None;
        }
        let normal = match face {
            0 => {
                let point = ray.origin + ray.dir * time;
                Vector::new(point.x, point.y, 0.0) / self.radius
            }
            1 => Vector::Z,
            _ => -Vector::Z,
        };
        Some(RayIntersection::new(time, normal * outward, FeatureId::Face(face)))
    }
}

/// A solid shape.
#[derive(Clone, Copy, Debug)]
pub(super) enum Solid {
    Cylinder(UprightCylinder),
    /// A box with its sides parallel to the axes.
    Block {
        center: [f32; 3],
        half: [f32; 3],
    },
}

impl Solid {
    /// Where the ray enters the solid, until `max_time`.
    #[expect(
        clippy::inline_always,
        reason = "without it a picture of a crowded room takes a sixth longer"
    )]
    #[inline(always)]
    pub(super) fn cast(&self, ray: &Ray, max_time: f32) -> Option<RayIntersection> {
        match self {
            Self::Cylinder(cylinder) => cylinder.cast(ray, max_time),
            Self::Block { center, half } => {
                let moved = ray.translate_by(-Vector::from_array(*center));
                Cuboid::new(Vector::from_array(*half)).cast_local_ray_and_get_normal(&moved, max_time, true)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const CYLINDER: UprightCylinder = UprightCylinder {
        radius: 0.5,
        bottom: -0.7,
        top: 0.7,
    };

    /// Whether a point is inside of the cylinder and not within `margin` of its surface.
    fn is_inside(point: Vector, margin: f32) -> bool {
        point.x.hypot(point.y) < CYLINDER.radius - margin && point.z.abs() < CYLINDER.top - margin
    }

    // parry's own cylinder is no reference: it finds hits by iteration, and misses some near edges.
    proptest! {
        #[test]
        fn an_upright_cylinder_is_hit_where_the_ray_first_is_inside(
            from in proptest::array::uniform3(-3.0f32..3.0).prop_map(Vector::from_array)
                .prop_filter("it starts inside", |from| !is_inside(*from, -1e-3)),
            to in proptest::array::uniform3(-0.6f32..0.6).prop_map(Vector::from_array),
        ) {
            let ray = Ray::new(from, to - from);
            let hit = CYLINDER.cast(&ray, 2.0);
            if let Some(hit) = hit {
                let point = ray.point_at(hit.time_of_impact);
                prop_assert!(is_inside(point, -1e-4) && !is_inside(point, 1e-4), "{point}");
                prop_assert!((hit.normal.length() - 1.0).abs() < 1e-3, "{}", hit.normal);
                // A ray that only touches the side may end up behind it by rounding.
                prop_assert!(hit.normal.dot(ray.dir) < 1e-2, "{} points away", hit.normal);
            }
            let end = hit.map_or(2.0, |hit| hit.time_of_impact);
            for step in 0..1000u16 {
                let point = ray.point_at(end * f32::from(step) / 1000.0);
                prop_assert!(!is_inside(point, 1e-4), "{point} is before {end}");
            }
        }
    }
}
