//! A course: patches of ground of several kinds, each at several levels of difficulty, on one height field.
//!
//! Patches are squares in a grid: a row is a level, a column a kind. The middle of a patch is a level platform, on which a
//! robot starts; its border is at height 0, where it meets its neighbours. Slopes and stairs are square
//! pyramids, alike on all four sides: `up` starts in a pit, `down` on a top (Rudin et al. 2021, section 3.2).

use rand::RngExt;
use serde::{Deserialize, Serialize};
use twinstep_model::{Ground, HeightField, Patches, stream};

use crate::config_error::{SimConfigError, in_range};

/// Side length of a patch [m].
const PATCH_M: f32 = 8.0;
/// Side length of a cell [m]: the width of a step's face.
const CELL_M: f32 = 0.04;
/// Half width of the platform in the middle of a patch, and width of its level border [m].
const PLATFORM_M: f32 = 0.8;
const BORDER_M: f32 = 0.24;
/// Length of a tread [m].
const TREAD_M: f32 = 0.32;
/// Side length of an obstacle, and of the squares between the heights of rough ground [m].
const OBSTACLE_M: f32 = 0.8;
const ROUGH_CELL_M: f32 = 0.2;
/// Waves in a patch.
const WAVES: f32 = 3.0;

/// Patches of ground by kind and level. A kind that is left out has no patches; the ranges are those of the first and the last
/// level.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CourseTerrain {
    /// Slopes up and down: angle [rad].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub slope_rad: Option<[f32; 2]>,
    /// Stairs up and down, with treads of 32 cm: height of a step [m].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stairs_m: Option<[f32; 2]>,
    /// Boxes of 80 cm at random places: height [m].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub obstacles_m: Option<[f32; 2]>,
    /// Waves along both axes: amplitude [m].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wave_m: Option<[f32; 2]>,
    /// Random heights every 20 cm: greatest height [m].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rough_m: Option<[f32; 2]>,
    /// Number of levels. Default: 10.
    #[serde(default = "CourseTerrain::default_levels")]
    pub levels: u32,
    /// Seed of obstacles and rough ground. Equal seeds give equal terrain, which all robots share.
    pub seed: u64,
}

/// Kind of a patch.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum PatchKind {
    /// A slope out of a pit.
    SlopeUp,
    /// A slope from a top.
    SlopeDown,
    /// Stairs out of a pit.
    StairsUp,
    /// Stairs from a top.
    StairsDown,
    /// Boxes.
    Obstacles,
    /// Waves.
    Wave,
    /// Random heights.
    Rough,
}

impl CourseTerrain {
    /// Everything up to what published policies of the Go2 walk.
    pub const FULL: CourseTerrain = CourseTerrain {
        slope_rad: Some([0.05, 0.5]),
        stairs_m: Some([0.02, 0.2]),
        obstacles_m: Some([0.02, 0.2]),
        wave_m: Some([0.02, 0.2]),
        rough_m: Some([0.0, 0.1]),
        levels: 10,
        seed: 1,
    };

    fn default_levels() -> u32 {
        10
    }

    /// Returns the kinds of the columns with their ranges.
    pub fn columns(&self) -> Vec<(PatchKind, [f32; 2])> {
        let kinds = [
            (PatchKind::SlopeUp, self.slope_rad),
            (PatchKind::SlopeDown, self.slope_rad),
            (PatchKind::StairsUp, self.stairs_m),
            (PatchKind::StairsDown, self.stairs_m),
            (PatchKind::Obstacles, self.obstacles_m),
            (PatchKind::Wave, self.wave_m),
            (PatchKind::Rough, self.rough_m),
        ];
        kinds.into_iter().filter_map(|(kind, range)| Some((kind, range?))).collect()
    }

    pub(crate) fn check(&self) -> Result<(), SimConfigError> {
        let ranges = [
            ("terrain.course.slope_rad", self.slope_rad, 0.7, "rad"),
            ("terrain.course.stairs_m", self.stairs_m, 0.3, "m"),
            ("terrain.course.obstacles_m", self.obstacles_m, 0.3, "m"),
            ("terrain.course.wave_m", self.wave_m, 0.3, "m"),
            ("terrain.course.rough_m", self.rough_m, 0.3, "m"),
        ];
        for (field, range, most, unit) in ranges {
            for value in range.into_iter().flatten() {
                in_range(field, value, [0.0, most], || format!("0 to {most} {unit}, at the first and the last level"))?;
            }
        }
        in_range("terrain.course.levels", self.levels as f32, [1.0, 20.0], || "1 to 20".to_owned())?;
        if self.columns().is_empty() {
            let allowed = "at least one of `slope_rad`, `stairs_m`, `obstacles_m`, `wave_m` and `rough_m`".to_owned();
            return Err(SimConfigError { field: "terrain.course", value: "{}".to_owned(), allowed });
        }
        Ok(())
    }

    /// Returns the angle [rad] or height [m] of a kind with this range at a level.
    pub fn size([first, last]: [f32; 2], level: usize, levels: u32) -> f32 {
        first + (last - first) * level as f32 / (levels.max(2) - 1) as f32
    }

    /// Returns the places of the patches.
    pub fn patches(&self) -> Patches {
        let (levels, columns) = (self.levels as usize, self.columns().len());
        let origin = [levels, columns].map(|count| -0.5 * PATCH_M * count as f32);
        Patches { origin, side: PATCH_M, levels, columns }
    }

    /// Builds the height field with its patches.
    pub fn ground(&self) -> Ground {
        let (columns, levels) = (self.columns(), self.levels as usize);
        let per_patch = (PATCH_M / CELL_M).round() as usize;
        let shape = [levels * per_patch + 1, columns.len() * per_patch + 1];
        let mut heights = vec![0.0; shape[0] * shape[1]];
        for level in 0..levels {
            for (column, (kind, range)) in columns.iter().enumerate() {
                let patch = Patch {
                    kind: *kind,
                    size: Self::size(*range, level, self.levels),
                    seed: self.seed.wrapping_add((level * 64 + column) as u64),
                };
                let of_patch = patch.heights(per_patch);
                for (row, values) in of_patch.chunks_exact(per_patch + 1).enumerate() {
                    let start = (level * per_patch + row) * shape[1] + column * per_patch;
                    heights[start..=start + per_patch].copy_from_slice(values);
                }
            }
        }
        let field = HeightField::centred(CELL_M, shape, heights).expect("the config was checked");
        Ground { height_field: Some(field.into()), patches: Some(self.patches()), ..Ground::FLAT }
    }
}

/// A patch, by what determines its heights.
struct Patch {
    kind: PatchKind,
    size: f32,
    seed: u64,
}

impl Patch {
    /// Returns the heights of `cells` × `cells` cells, row by row.
    fn heights(&self, cells: usize) -> Vec<f32> {
        let middle = cells as f32 / 2.0;
        let knots = (PATCH_M / ROUGH_CELL_M).round() as usize + 1;
        let mut random = stream(self.seed, "patch", 0);
        let random: Vec<f32> = (0..knots * knots).map(|_| random.random()).collect();
        let at = |index: usize| {
            let [x, y] = [index / (cells + 1), index % (cells + 1)].map(|at| (at as f32 - middle) * CELL_M);
            self.height(x, y, &random, knots)
        };
        (0..(cells + 1) * (cells + 1)).map(at).collect()
    }

    /// Returns the height at (`x`, `y`), relative to the middle of the patch [m].
    fn height(&self, x: f32, y: f32, random: &[f32], knots: usize) -> f32 {
        let half = PATCH_M / 2.0;
        let from_middle = x.abs().max(y.abs());
        let from_border = half - from_middle;
        // Waves and rough ground fade to the platform and to the border within 40 cm.
        let fade = ((from_middle - PLATFORM_M).min(from_border - BORDER_M) / 0.4).clamp(0.0, 1.0);
        let length = half - PLATFORM_M - BORDER_M;
        let along = (from_middle - PLATFORM_M).clamp(0.0, length);
        // Rounding must not move a tread by a cell.
        let treads = |along: f32| (along / TREAD_M + 1e-3).floor();
        let climbed = |along: f32| if along > 0.0 { (treads(along - 1e-3) + 1.0).min(treads(length)) } else { 0.0 };
        match self.kind {
            PatchKind::SlopeUp => (along - length) * self.size.tan(),
            PatchKind::SlopeDown => (length - along) * self.size.tan(),
            PatchKind::StairsUp => (climbed(along) - treads(length)) * self.size,
            PatchKind::StairsDown => (treads(length) - climbed(along)) * self.size,
            PatchKind::Obstacles => {
                let block = |at: f32| ((at + half) / OBSTACLE_M).floor() as usize;
                let is_high = random[(block(x) * knots + block(y)) % random.len()] < 0.5;
                let is_free = from_middle <= PLATFORM_M || from_border < BORDER_M;
                if is_high && !is_free { self.size } else { 0.0 }
            }
            PatchKind::Wave => {
                let wave = |at: f32| (std::f32::consts::TAU * WAVES * at / PATCH_M).cos();
                fade * self.size * 0.5 * (wave(x) + wave(y))
            }
            PatchKind::Rough => {
                let [(row, u), (column, v)] = [x, y].map(|at| {
                    let at = ((at + half) / ROUGH_CELL_M).clamp(0.0, (knots - 1) as f32 - 1e-3);
                    (at as usize, at.fract())
                });
                let knot = |row: usize, column: usize| random[row * knots + column];
                let near = knot(row, column) * (1.0 - v) + knot(row, column + 1) * v;
                let far = knot(row + 1, column) * (1.0 - v) + knot(row + 1, column + 1) * v;
                fade * self.size * (near * (1.0 - u) + far * u)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn course(course: CourseTerrain) -> (Ground, Patches) {
        course.check().expect("valid");
        let ground = course.ground();
        let patches = ground.patches.expect("patches");
        (ground, patches)
    }

    #[test]
    fn stairs_have_steps_of_their_height_on_treads_of_their_length() {
        let (ground, patches) =
            course(CourseTerrain { stairs_m: Some([0.1, 0.2]), levels: 2, seed: 1, ..CourseTerrain::default() });
        for (level, height) in [(0, 0.1), (1, 0.2)] {
            let [x, y] = patches.centre(level, 0);
            let profile: Vec<f32> = (0..400).map(|index| ground.height(x + index as f32 * 0.01, y)).collect();
            let levels: Vec<f32> = profile.windows(5).filter(|part| part[0] == part[4]).map(|part| part[0]).collect();
            let mut treads = levels.clone();
            treads.dedup();
            assert_eq!(treads.len(), 10, "{treads:?}");
            assert!(treads.windows(2).all(|pair| (pair[1] - pair[0] - height).abs() < 1e-4), "{treads:?}");
            assert!((treads[0] + 9.0 * height).abs() < 1e-4 && treads[9] == 0.0, "out of a pit: {treads:?}");
            let [x, y] = patches.centre(level, 1);
            assert!((ground.height(x, y) - 9.0 * height).abs() < 1e-4, "from a top");
        }
    }

    #[test]
    fn slopes_have_their_angle_in_every_direction() {
        let (ground, patches) =
            course(CourseTerrain { slope_rad: Some([0.3, 0.3]), levels: 1, seed: 1, ..CourseTerrain::default() });
        let [x, y] = patches.centre(0, 0);
        for (dx, dy) in [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)] {
            let rise = ground.height(x + 3.0 * dx, y + 3.0 * dy) - ground.height(x + 2.0 * dx, y + 2.0 * dy);
            assert!((rise - 0.3f32.tan()).abs() < 1e-3, "{rise}");
        }
    }

    #[test]
    fn patches_begin_with_a_platform_and_meet_at_height_0() {
        let (ground, patches) = course(CourseTerrain::FULL);
        for level in 0..10 {
            for column in 0..7 {
                let [x, y] = patches.centre(level, column);
                for (dx, dy) in [(0.4, 0.3), (-0.5, 0.5), (0.0, -0.6)] {
                    assert_eq!(
                        ground.sample(x + dx, y + dy),
                        (ground.height(x, y), [0.0, 0.0, 1.0]),
                        "{level}, {column}"
                    );
                    let [border_x, border_y] = [x + 4.0, y + 4.0 * dy];
                    assert_eq!(ground.height(border_x, border_y), 0.0, "{level}, {column}");
                }
            }
        }
    }

    #[test]
    fn course_without_patches_or_out_of_range_is_refused_by_name() {
        let none = CourseTerrain { levels: 3, seed: 1, ..CourseTerrain::default() };
        assert!(
            none.check()
                .expect_err("refused")
                .to_string()
                .contains("`sim.terrain.course` = {} is not allowed: at least one")
        );
        let steep = CourseTerrain { slope_rad: Some([0.1, 1.2]), ..CourseTerrain::FULL };
        let expected =
            "`sim.terrain.course.slope_rad` = 1.2 is not allowed: 0 to 0.7 rad, at the first and the last level";
        assert_eq!(steep.check().expect_err("refused").to_string(), expected);
    }
}
