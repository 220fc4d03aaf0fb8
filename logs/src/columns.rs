//! The closed grammar of column names: which quantities a log can hold, and of what.

/// What a quantity belongs to, which decides how its columns are named.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ColumnOwner {
    /// One column with the quantity's own name.
    Robot,
    /// `<quantity>_<joint>`.
    Joint,
    /// One column for all joints with the quantity's own name, or `<quantity>_<joint>`.
    RobotOrJoint,
    /// `<quantity>_<leg>`.
    Leg,
    /// `<quantity>_<axis>` with one of these axes.
    Axis(&'static [&'static str]),
}

/// Whether a cell of a column may be missing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum MissingCells {
    /// Every row needs a number.
    Forbidden,
    /// A row may have none.
    Allowed,
}

/// One measured or commanded quantity.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Quantity {
    pub name: &'static str,
    pub unit: &'static str,
    pub of: ColumnOwner,
    pub cells: MissingCells,
}

/// A column's name, read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Column<'a> {
    pub quantity: &'static Quantity,
    /// The joint, leg or axis; none for a column of the whole robot.
    pub part: Option<&'a str>,
}

const XYZ: ColumnOwner = ColumnOwner::Axis(&["x", "y", "z"]);
const WXYZ: ColumnOwner = ColumnOwner::Axis(&["w", "x", "y", "z"]);

const fn required(name: &'static str, unit: &'static str, of: ColumnOwner) -> Quantity {
    Quantity { name, unit, of, cells: MissingCells::Forbidden }
}

const fn optional(name: &'static str, unit: &'static str, of: ColumnOwner) -> Quantity {
    Quantity { name, unit, of, cells: MissingCells::Allowed }
}

/// Every quantity, in the order in which columns are written.
pub(crate) static QUANTITIES: [Quantity; 20] = [
    required("t", "s", ColumnOwner::Robot),
    required("segment", "", ColumnOwner::Robot),
    required("episode", "", ColumnOwner::Robot),
    required("kp", "N·m/rad", ColumnOwner::RobotOrJoint),
    required("kd", "N·m·s/rad", ColumnOwner::RobotOrJoint),
    required("q_cmd", "rad", ColumnOwner::Joint),
    optional("dq_cmd", "rad/s", ColumnOwner::Joint),
    optional("tau_ff", "N·m", ColumnOwner::Joint),
    required("q", "rad", ColumnOwner::Joint),
    optional("dq", "rad/s", ColumnOwner::Joint),
    optional("tau_measured", "N·m", ColumnOwner::Joint),
    optional("temp", "°C", ColumnOwner::Joint),
    optional("gyro", "rad/s", XYZ),
    optional("acc", "m/s²", XYZ),
    optional("quat", "", WXYZ),
    optional("pos", "m", XYZ),
    optional("vel", "m/s", XYZ),
    optional("contact", "", ColumnOwner::Leg),
    optional("foot_force", "N", ColumnOwner::Leg),
    optional("battery_V", "V", ColumnOwner::Robot),
];

/// The quantity with exactly this name.
pub(crate) fn quantity(name: &str) -> Option<&'static Quantity> {
    QUANTITIES.iter().find(|quantity| quantity.name == name)
}

impl<'a> Column<'a> {
    /// Reads a column's name; none for a name outside the grammar.
    pub fn parse(name: &'a str) -> Option<Column<'a>> {
        if let Some(quantity) = quantity(name) {
            let whole = matches!(quantity.of, ColumnOwner::Robot | ColumnOwner::RobotOrJoint);
            return whole.then_some(Column { quantity, part: None });
        }
        // The longest quantity wins: `q_cmd_FL_hip` is the command of `FL_hip`, not the position of `cmd_FL_hip`.
        let (quantity, part) = QUANTITIES
            .iter()
            .filter_map(|quantity| Some((quantity, name.strip_prefix(quantity.name)?.strip_prefix('_')?)))
            .max_by_key(|(quantity, _)| quantity.name.len())?;
        let known = match quantity.of {
            ColumnOwner::Robot => false,
            ColumnOwner::Joint | ColumnOwner::RobotOrJoint | ColumnOwner::Leg => !part.is_empty(),
            ColumnOwner::Axis(axes) => axes.contains(&part),
        };
        known.then_some(Column { quantity, part: Some(part) })
    }

    /// The joint that the column belongs to.
    pub fn joint(&self) -> Option<&'a str> {
        matches!(self.quantity.of, ColumnOwner::Joint | ColumnOwner::RobotOrJoint).then_some(self.part).flatten()
    }

    /// The place of the column's quantity in [`QUANTITIES`].
    pub fn rank(&self) -> usize {
        QUANTITIES.iter().position(|quantity| quantity.name == self.quantity.name).unwrap_or(QUANTITIES.len())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(name: &str) -> Option<(&'static str, Option<&str>)> {
        Column::parse(name).map(|column| (column.quantity.name, column.part))
    }

    #[test]
    fn names_split_into_a_quantity_and_what_it_is_of() {
        assert_eq!(read("t"), Some(("t", None)));
        assert_eq!(read("q_FL_hip"), Some(("q", Some("FL_hip"))));
        assert_eq!(read("tau_measured_RR_calf"), Some(("tau_measured", Some("RR_calf"))));
        assert_eq!(read("quat_w"), Some(("quat", Some("w"))));
        assert_eq!(read("foot_force_RL"), Some(("foot_force", Some("RL"))));
        assert_eq!(read("battery_V"), Some(("battery_V", None)));
    }

    #[test]
    fn commands_are_told_from_positions() {
        assert_eq!(read("q_cmd_FL_hip"), Some(("q_cmd", Some("FL_hip"))));
        assert_eq!(read("dq_cmd_FL_hip"), Some(("dq_cmd", Some("FL_hip"))));
    }

    #[test]
    fn gains_are_of_the_robot_or_of_a_joint() {
        assert_eq!(read("kp"), Some(("kp", None)));
        assert_eq!(read("kp_FL_hip"), Some(("kp", Some("FL_hip"))));
    }

    #[test]
    fn other_names_are_outside_the_grammar() {
        for name in ["", "q", "q_", "q_cmd", "q_cmd_", "gyro", "gyro_w", "t_ns", "segment_0", "battery", "Time"] {
            assert_eq!(read(name), None, "{name}");
        }
    }
}
