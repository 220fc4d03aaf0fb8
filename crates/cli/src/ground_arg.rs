//! The option `--ground KIND=SIZE`: a course with one level.

use twinstep_sim::CourseTerrain;

/// Ground of one kind with its size.
#[derive(Clone, Copy)]
pub struct GroundArg {
    kind: fn(&mut CourseTerrain) -> &mut Option<[f32; 2]>,
    size: f32,
}

/// Reads a kind and its size.
pub fn ground(text: &str) -> Result<GroundArg, String> {
    let (kind, size) = text.split_once('=').ok_or("a kind and a size are wanted, such as stairs=0.15")?;
    let kind: fn(&mut CourseTerrain) -> &mut Option<[f32; 2]> = match kind {
        "slope" => |course| &mut course.slope_rad,
        "stairs" => |course| &mut course.stairs_m,
        "obstacles" => |course| &mut course.obstacles_m,
        "wave" => |course| &mut course.wave_m,
        "rough" => |course| &mut course.rough_m,
        _ => return Err(format!("there is no ground `{kind}`: slope, stairs, obstacles, wave or rough")),
    };
    let size = size.parse().map_err(|_| format!("`{size}` is not a number"))?;
    Ok(GroundArg { kind, size })
}

/// Returns the course of these kinds; `None` for none.
pub fn course(grounds: &[GroundArg]) -> Option<CourseTerrain> {
    let mut terrain = CourseTerrain { levels: 1, seed: 1, ..CourseTerrain::default() };
    for GroundArg { kind, size } in grounds {
        *kind(&mut terrain) = Some([*size; 2]);
    }
    (!grounds.is_empty()).then_some(terrain)
}
