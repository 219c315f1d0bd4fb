//! Streets behind the objects of a scene: rows of houses, trees, hedges and lamp posts.
use dipir_scene::mesh::TriangleMesh;
use glam::{DMat4, DQuat, DVec3, Vec3};

use crate::random::Draw;
use crate::scene::Paint;
use crate::shapes::{Shape, cuboid};

/// Everything of a scene that is no placed object: a mesh and its materials.
#[derive(Debug, Default)]
pub struct Backdrop {
    /// In scene coordinates; materials of triangles index `paints`.
    pub mesh: TriangleMesh,
    /// Materials.
    pub paints: Vec<Paint>,
}

impl Backdrop {
    /// A street that begins `near` metres behind the origin, towards -z. The view is `width` metres wide there.
    pub fn street(draw: &mut Draw<'_>, near: f32, width: f32) -> Self {
        let mut backdrop = Self::default();
        if draw.chance(0.75) {
            let depth = near + draw.range(0.5, 9.0);
            backdrop.houses(draw, depth);
        }
        for _ in 0..draw.below(3) {
            let at = draw.point_behind(near, width);
            backdrop.tree(draw, at);
        }
        // A tree outside of the picture, whose shadow may be visible.
        if draw.chance(0.3) {
            let side = width * draw.range(0.6, 1.2);
            let side = if draw.chance(0.5) { side } else { -side };
            let at = Vec3::new(side, 0.0, draw.range(-1.0, 3.0));
            backdrop.tree(draw, at);
        }
        if draw.chance(0.4) {
            let at = draw.point_behind(near, width);
            backdrop.hedge(draw, at);
        }
        if draw.chance(0.3) {
            let at = draw.point_behind(near, width);
            backdrop.lamp(draw, at);
        }
        backdrop
    }

    /// Adds a paint and returns its index.
    pub(crate) fn paint(&mut self, paint: Paint) -> u32 {
        self.paints.push(paint);
        self.paints.len() as u32 - 1
    }

    /// Three houses side by side with windows and ledges, `depth` metres behind the origin.
    pub(crate) fn houses(&mut self, draw: &mut Draw<'_>, depth: f32) {
        let scale = draw.range(0.5, 1.6);
        let yaw = draw.range(-0.6, 0.6);
        let dark = self.paint(Paint {
            color: Vec3::splat(draw.range(0.01, 0.06)),
            roughness: draw.range(0.2, 0.6),
            ..draw.masonry()
        });
        let trim = draw.masonry();
        let trim = self.paint(trim);
        let mut row = TriangleMesh::default();
        let mut x = -draw.range(6.0, 12.0);
        for _ in 0..3 {
            let (width, floors) = (draw.range(4.0, 9.0), 1 + draw.below(4));
            let (storey, bay) = (draw.range(2.2, 3.2), draw.range(1.4, 3.0));
            let height = storey * floors as f32;
            let wall = draw.masonry();
            let wall = self.paint(wall);
            let middle = Vec3::new(x + 0.5 * width, 0.5 * height, -2.0);
            let half = Vec3::new(0.5 * width, 0.5 * height, 2.0);
            row.append(cuboid(middle, half), wall);
            let opening = Vec3::new(
                bay * draw.range(0.15, 0.3),
                storey * draw.range(0.2, 0.32),
                0.02,
            );
            let (ledge, blind) = (draw.range(0.03, 0.25), draw.chance(0.15));
            let bays = (width / bay) as usize;
            for floor in 0..floors {
                let y = storey * (floor as f32 + 0.5);
                let at = Vec3::new(middle.x, storey * (floor as f32 + 1.0), 0.0);
                row.append(cuboid(at, Vec3::new(half.x, 0.08, ledge)), trim);
                for i in 0..bays {
                    let at = x + width * (i as f32 + 0.5) / bays as f32;
                    if !blind {
                        row.append(cuboid(Vec3::new(at, y, 0.0), opening), dark);
                    }
                }
            }
            x += width;
        }
        row.transform(&DMat4::from_scale_rotation_translation(
            DVec3::splat(f64::from(scale)),
            DQuat::from_rotation_y(f64::from(yaw)),
            DVec3::new(0.0, 0.0, -f64::from(depth + 9.0 * scale * yaw.sin().abs())),
        ));
        self.mesh.append(row, 0);
    }

    fn tree(&mut self, draw: &mut Draw<'_>, at: Vec3) {
        let (height, thick) = (draw.range(1.0, 3.5), draw.range(0.04, 0.16));
        let bark = Paint {
            color: Vec3::new(0.16, 0.11, 0.07) * draw.range(0.4, 1.6),
            ..draw.masonry()
        };
        let bark = self.paint(bark);
        let trunk = cuboid(
            at + Vec3::Y * (0.5 * height),
            Vec3::new(thick, 0.5 * height, thick),
        );
        self.mesh.append(trunk, bark);
        let leaves = draw.leaves();
        let leaves = self.paint(leaves);
        let size = height * draw.range(0.25, 0.5);
        for _ in 0..3 + draw.below(4) {
            let aside = Vec3::new(
                draw.range(-0.8, 0.8),
                draw.range(-0.2, 0.8),
                draw.range(-0.8, 0.8),
            );
            let clump = draw.clump(at + Vec3::Y * height + aside * size, size);
            self.mesh.append(clump, leaves);
        }
    }

    fn hedge(&mut self, draw: &mut Draw<'_>, at: Vec3) {
        let half = Vec3::new(
            draw.range(0.5, 2.5),
            draw.range(0.12, 0.5),
            draw.range(0.2, 0.4),
        );
        let stone = draw.masonry();
        let stone = self.paint(stone);
        self.mesh.append(cuboid(at + Vec3::Y * half.y, half), stone);
        if draw.chance(0.6) {
            let leaves = draw.leaves();
            let leaves = self.paint(leaves);
            let top = at + Vec3::Y * (2.0 * half.y);
            for i in 0..6 {
                let x = half.x * ((i as f32 + 0.5) / 3.0 - 1.0);
                let clump = draw.clump(top + Vec3::X * x, half.z * 1.4);
                self.mesh.append(clump, leaves);
            }
        }
    }

    fn lamp(&mut self, draw: &mut Draw<'_>, at: Vec3) {
        let (height, thick) = (draw.range(1.5, 4.0), draw.range(0.02, 0.06));
        let post = draw.masonry();
        let post = self.paint(post);
        let middle = at + Vec3::Y * (0.5 * height);
        self.mesh
            .append(cuboid(middle, Vec3::new(thick, 0.5 * height, thick)), post);
        let globe = draw.masonry();
        let globe = self.paint(globe);
        let mut ball = Shape::Ball.mesh([0.5; 3]);
        ball.transform(&DMat4::from_scale_rotation_translation(
            DVec3::splat(f64::from(draw.range(0.2, 0.45))),
            DQuat::IDENTITY,
            (at + Vec3::Y * height).as_dvec3(),
        ));
        self.mesh.append(ball, globe);
    }
}

impl Draw<'_> {
    /// A random point on the ground, more than `near` metres behind the origin.
    fn point_behind(&mut self, near: f32, width: f32) -> Vec3 {
        let depth = near + self.range(0.3, 6.0);
        Vec3::new(self.range(-0.7, 0.7) * width, 0.0, -depth)
    }

    /// Colour of plaster, stone or brick.
    pub(crate) fn masonry(&mut self) -> Paint {
        let tint = Vec3::new(
            self.range(0.8, 1.1),
            self.range(0.65, 1.0),
            self.range(0.5, 1.0),
        );
        Paint {
            color: tint * self.range(0.08, 0.7),
            roughness: self.range(0.6, 1.0),
            metallic: false,
            word: "grey",
        }
    }

    /// Colour of leaves.
    pub(crate) fn leaves(&mut self) -> Paint {
        let color = Vec3::new(
            self.range(0.03, 0.2),
            self.range(0.08, 0.25),
            self.range(0.01, 0.06),
        );
        Paint {
            color,
            ..self.masonry()
        }
    }

    /// A clump of leaves, about `size` metres wide, around `center`.
    pub(crate) fn clump(&mut self, center: Vec3, size: f32) -> TriangleMesh {
        let p = [0; 3].map(|_| self.range(0.0, 1.0));
        let mut mesh = Shape::Rock.mesh(p);
        let turn = DQuat::from_rotation_z(f64::from(self.range(0.0, std::f32::consts::TAU)));
        mesh.transform(&DMat4::from_scale_rotation_translation(
            DVec3::splat(f64::from(size * self.range(1.0, 1.8))),
            turn,
            center.as_dvec3(),
        ));
        mesh
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dipir_diffusion::noise::NoiseStream;

    #[test]
    fn streets_leave_the_objects_free_and_every_triangle_has_a_paint() {
        let (mut drawn, mut houses) = (0, 0);
        for index in 0..200 {
            let mut stream = NoiseStream::new(7, index);
            let backdrop = Backdrop::street(&mut Draw::new(&mut stream), 1.6, 3.5);
            let mesh = &backdrop.mesh;
            assert!(
                mesh.materials
                    .iter()
                    .all(|m| (*m as usize) < backdrop.paints.len())
            );
            assert_eq!(mesh.materials.len(), mesh.indices.len());
            for p in &mesh.positions {
                // Leaves may be above the objects.
                let away = p.x.hypot(p.z);
                assert!(p.is_finite() && (away > 1.2 || p.y > 0.4), "{index}: {p}");
            }
            drawn += usize::from(!mesh.indices.is_empty());
            houses += usize::from(
                mesh.bounds()
                    .is_some_and(|(low, high)| high.x - low.x > 7.0),
            );
        }
        // Three in four have houses, nearly all have something.
        assert!(
            drawn > 180 && (120..180).contains(&houses),
            "{drawn} {houses}"
        );
    }
}
