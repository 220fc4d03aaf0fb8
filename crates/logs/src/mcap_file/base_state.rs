//! Position and velocity of the base, from `/sportmodestate`.

use crate::go2_message::BaseState;

/// Share of the rows that must have a position.
const MIN_COVERED: f64 = 0.99;

/// Returns the columns `pos_*` and `vel_*` at the times of the rows [ns], linear between the messages. Empty if the messages
/// do not cover the rows: a robot sends none after its built-in controller was released.
pub(crate) fn base_columns(times: &[u64], states: &[(u64, BaseState)]) -> Vec<(String, Vec<f64>)> {
    let (mut next, mut covered) = (0, 0);
    let mut cells: [Vec<f64>; 6] = std::array::from_fn(|_| Vec::with_capacity(times.len()));
    for time in times {
        while states.get(next).is_some_and(|(at, _)| at < time) {
            next += 1;
        }
        let around = next.checked_sub(1).and_then(|before| Some((states.get(before)?, states.get(next)?)));
        let exact = states.get(next).filter(|(at, _)| at == time).map(|(_, state)| state.values());
        let between = around.map(|((start, one), (end, other))| {
            let share = (time - start) as f64 / (end - start).max(1) as f64;
            let (one, other) = (one.values(), other.values());
            std::array::from_fn(|value| one[value] + share * (other[value] - one[value]))
        });
        let values = exact.or(between);
        covered += usize::from(values.is_some());
        for (column, value) in cells.iter_mut().zip(values.unwrap_or([f64::NAN; 6])) {
            column.push(value);
        }
    }
    if (covered as f64) < MIN_COVERED * times.len() as f64 || states.is_empty() {
        return Vec::new();
    }
    let names = ["pos_x", "pos_y", "pos_z", "vel_x", "vel_y", "vel_z"];
    names.map(str::to_owned).into_iter().zip(cells).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn states() -> Vec<(u64, BaseState)> {
        let state = |x: f32| BaseState { position: [x, 0.0, 0.3], velocity: [2.0 * x, 0.0, 0.0] };
        vec![(0, state(1.0)), (10, state(2.0)), (20, state(4.0))]
    }

    #[test]
    fn values_are_linear_between_messages() {
        let columns = base_columns(&[0, 5, 10, 15, 20], &states());
        assert_eq!(columns[0], ("pos_x".to_owned(), vec![1.0, 1.5, 2.0, 3.0, 4.0]));
        assert_eq!(columns[3].1, [2.0, 3.0, 4.0, 6.0, 8.0]);
    }

    #[test]
    fn messages_that_cease_give_no_columns() {
        assert!(base_columns(&[0, 10, 20, 30, 40], &states()).is_empty());
        assert!(base_columns(&[0], &[]).is_empty());
    }
}
