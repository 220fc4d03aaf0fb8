//! Orders that an observation may have if no config contains it.
//!
//! Programs agree on the end, joint positions, velocities and the previous action, and differ in the vectors before it and in the
//! history.

use super::facts::InputFacts;
use super::merge::Draft;
use crate::mapping::{History, HistoryLayout, HistoryOrder, TermName};

/// Returns the mapping with every other order, each with what it is.
pub fn other_orders(draft: &Draft) -> Vec<(String, Draft)> {
    let Some(input) = draft.observation.as_ref().filter(|_| draft.is_order_assumed) else { return Vec::new() };
    let count = input.terms.iter().take_while(|term| is_vector(term.term)).count();
    let mut orders = Vec::new();
    for order in permutations(count) {
        let vectors = order.iter().map(|index| input.terms[*index].clone());
        let terms = vectors.chain(input.terms[count..].iter().cloned()).collect();
        let input = InputFacts { terms, ..input.clone() };
        let histories = std::iter::once(&input).chain(draft.inputs.values()).any(|input| input.history.is_some());
        for layout in if histories { &LAYOUTS[..] } else { &LAYOUTS[..1] } {
            let other = with_history(draft, &input, layout);
            if other.observation != draft.observation || other.inputs != draft.inputs {
                orders.push((description(&input, layout, histories), other));
            }
        }
    }
    orders
}

/// Layout and order of a history, with their description.
type HistoryForm = (HistoryLayout, HistoryOrder, &'static str);

const LAYOUTS: [HistoryForm; 4] = [
    (HistoryLayout::Frames, HistoryOrder::NewestFirst, "step by step, the newest first"),
    (HistoryLayout::Frames, HistoryOrder::OldestFirst, "step by step, the oldest first"),
    (HistoryLayout::Terms, HistoryOrder::OldestFirst, "term by term, the oldest first"),
    (HistoryLayout::Terms, HistoryOrder::NewestFirst, "term by term, the newest first"),
];

fn with_history(draft: &Draft, input: &InputFacts, (layout, order, _): &HistoryForm) -> Draft {
    let changed = |input: &InputFacts| {
        let history = input.history.map(|History { length, .. }| History { length, layout: *layout, order: *order });
        InputFacts { history, ..input.clone() }
    };
    let inputs = draft.inputs.iter().map(|(name, input)| (name.clone(), changed(input))).collect();
    Draft { observation: Some(changed(input)), inputs, ..draft.clone() }
}

fn is_vector(term: TermName) -> bool {
    use TermName::{BaseAngularVelocity, BaseLinearVelocity, ProjectedGravity, VelocityCommand};
    matches!(term, BaseLinearVelocity | BaseAngularVelocity | ProjectedGravity | VelocityCommand)
}

fn description(input: &InputFacts, (_, _, history): &HistoryForm, has_history: bool) -> String {
    let names: Vec<_> =
        input.terms.iter().take_while(|term| is_vector(term.term)).map(|term| term.term.name()).collect();
    let history = if has_history { format!("; history {history}") } else { String::new() };
    format!("{}{history}", names.join(", "))
}

/// Returns all orders of the numbers below `count`; the first is that of the numbers.
fn permutations(count: usize) -> Vec<Vec<usize>> {
    if count == 0 {
        return vec![Vec::new()];
    }
    let extended = |first: usize| {
        let rest = permutations(count - 1).into_iter();
        rest.map(move |rest| {
            let others: Vec<usize> = (0..count).filter(|number| *number != first).collect();
            std::iter::once(first).chain(rest.into_iter().map(|index| others[index])).collect()
        })
    };
    (0..count).flat_map(extended).collect()
}

#[cfg(test)]
mod tests {
    use super::permutations;

    #[test]
    fn permutations_are_all_different_and_begin_with_the_given_order() {
        let all = permutations(4);
        let distinct: std::collections::BTreeSet<_> = all.iter().collect();
        assert_eq!((all.len(), distinct.len()), (24, 24));
        assert_eq!(all[0], [0, 1, 2, 3]);
    }
}
