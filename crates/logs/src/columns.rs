//! Grammar of column names: the quantities that a log can contain.

/// What a quantity belongs to, which determines the names of its columns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ColumnOwner {
    /// One column with the name of the quantity.
    Robot,
    /// `<quantity>_<joint>`.
    Joint,
    /// One column for all joints with the name of the quantity, or `<quantity>_<joint>`.
    RobotOrJoint,
    /// `<quantity>_<leg>`.
    Leg,
    /// `<quantity>_<axis>` with one of these axes.
    Axis(&'static [&'static str]),
}

/// Whether cells of a column may be missing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum MissingCells {
    /// Every row needs a number.
    Forbidden,
    /// Cells may be missing.
    Allowed,
}

/// Measured or commanded quantity.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Quantity {
    pub name: &'static str,
    pub unit: &'static str,
    pub of: ColumnOwner,
    pub cells: MissingCells,
}

/// Parsed name of a column.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Column<'a> {
    pub quantity: &'static Quantity,
    /// The joint, leg or axis; `None` for a column of the whole robot.
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

/// All quantities, in the order in which columns are written.
pub(crate) static QUANTITIES: [Quantity; 21] = [
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
    optional("current_abs", "", ColumnOwner::Joint),
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

/// Returns the quantity with exactly this name.
pub(crate) fn quantity(name: &str) -> Option<&'static Quantity> {
    QUANTITIES.iter().find(|quantity| quantity.name == name)
}

impl<'a> Column<'a> {
    /// Parses the name of a column. Returns `None` for a name outside the grammar.
    pub fn parse(name: &'a str) -> Option<Column<'a>> {
        if let Some(quantity) = quantity(name) {
            let whole = matches!(quantity.of, ColumnOwner::Robot | ColumnOwner::RobotOrJoint);
            return whole.then_some(Column { quantity, part: None });
        }
        // The longest match applies: `q_cmd_FL_hip` is the command of `FL_hip`, not the position of `cmd_FL_hip`.
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

    /// Returns the joint of the column, if it has one.
    pub fn joint(&self) -> Option<&'a str> {
        matches!(self.quantity.of, ColumnOwner::Joint | ColumnOwner::RobotOrJoint).then_some(self.part).flatten()
    }

    /// Returns the index of the column's quantity in [`QUANTITIES`].
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
    fn names_are_split_into_quantity_and_owner() {
        assert_eq!(read("t"), Some(("t", None)));
        assert_eq!(read("q_FL_hip"), Some(("q", Some("FL_hip"))));
        assert_eq!(read("tau_measured_RR_calf"), Some(("tau_measured", Some("RR_calf"))));
        assert_eq!(read("quat_w"), Some(("quat", Some("w"))));
        assert_eq!(read("foot_force_RL"), Some(("foot_force", Some("RL"))));
        assert_eq!(read("battery_V"), Some(("battery_V", None)));
    }

    #[test]
    fn commands_are_distinguished_from_positions() {
        assert_eq!(read("q_cmd_FL_hip"), Some(("q_cmd", Some("FL_hip"))));
        assert_eq!(read("dq_cmd_FL_hip"), Some(("dq_cmd", Some("FL_hip"))));
    }

    #[test]
    fn gains_belong_to_the_robot_or_to_a_joint() {
        assert_eq!(read("kp"), Some(("kp", None)));
        assert_eq!(read("kp_FL_hip"), Some(("kp", Some("FL_hip"))));
    }

    #[test]
    fn unknown_names_are_outside_the_grammar() {
        for name in ["", "q", "q_", "q_cmd", "q_cmd_", "gyro", "gyro_w", "t_ns", "segment_0", "battery", "Time"] {
            assert_eq!(read(name), None, "{name}");
        }
    }
}
