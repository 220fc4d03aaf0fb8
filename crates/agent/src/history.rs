//! The last observations of a policy, in the order in which its network reads them.

use std::collections::VecDeque;

use crate::mapping::{History, HistoryLayout, HistoryOrder, Term, steps};

/// Last values of each term.
#[derive(Clone, Debug)]
pub struct ObservationHistory {
    /// For each term the last values, oldest first; empty after a reset.
    terms: Vec<VecDeque<Vec<f32>>>,
    /// Number of steps of each term.
    steps: Vec<usize>,
    layout: HistoryLayout,
    order: HistoryOrder,
}

impl ObservationHistory {
    /// Creates an empty history.
    pub fn new(terms: &[Term], history: Option<History>) -> Self {
        let steps: Vec<usize> = terms.iter().map(|term| steps(term, history)).collect();
        // Without a table the order does not matter, because every term has one step.
        let (layout, order) = history
            .map_or((HistoryLayout::Terms, HistoryOrder::OldestFirst), |history| (history.layout, history.order));
        Self { terms: vec![VecDeque::new(); steps.len()], steps, layout, order }
    }

    /// Removes all values.
    pub fn clear(&mut self) {
        self.terms.iter_mut().for_each(VecDeque::clear);
    }

    /// Adds the present values of a term. The first ones after a reset fill the whole history.
    pub fn push(&mut self, term: usize, values: Vec<f32>) {
        let past = &mut self.terms[term];
        past.resize(self.steps[term], values.clone());
        past.pop_front();
        past.push_back(values);
    }

    /// Returns the input of the network.
    pub fn input(&self) -> Vec<f32> {
        let value = |term: usize, position: usize| {
            let past = &self.terms[term];
            match self.order {
                HistoryOrder::OldestFirst => &past[position],
                HistoryOrder::NewestFirst => &past[past.len() - 1 - position],
            }
        };
        let terms = 0..self.terms.len();
        let places: Vec<(usize, usize)> = match self.layout {
            HistoryLayout::Terms => {
                terms.flat_map(|term| (0..self.steps[term]).map(move |position| (term, position))).collect()
            }
            // All terms have the same number of steps.
            HistoryLayout::Frames => {
                (0..self.steps[0]).flat_map(|position| terms.clone().map(move |term| (term, position))).collect()
            }
        };
        places.into_iter().flat_map(|(term, position)| value(term, position).iter().copied()).collect()
    }
}
