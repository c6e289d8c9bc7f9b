//! Products of rows on their way into the information.

use crate::triangle::Triangle;

/// Rows that wait to enter the information, with their weights: four at a time cost half of four alone.
#[derive(Debug, Clone)]
pub struct Staged<const N: usize> {
    rows: [[f64; N]; 4],
    weight: [f64; 4],
    count: usize,
}

impl<const N: usize> Staged<N> {
    /// None wait.
    pub const NONE: Self = Self { rows: [[0.0; N]; 4], weight: [0.0; 4], count: 0 };

    /// `information += weight row row^T`, later.
    pub fn push(&mut self, row: &[f64; N], weight: f64) {
        if let (Some(to), Some(its)) = (self.rows.get_mut(self.count), self.weight.get_mut(self.count)) {
            (*to, *its) = (*row, weight);
            self.count += 1;
        }
    }

    /// True if no more can wait.
    pub fn is_full(&self) -> bool {
        self.count == self.rows.len()
    }

    /// The rows that wait; others are of no weight.
    pub fn rows(&self) -> &[[f64; N]; 4] {
        &self.rows
    }

    /// How many wait: the place of the next one.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Let all that wait enter.
    pub fn settle<const T: usize>(&mut self, information: &mut Triangle<N, T, f64>) {
        // what is left of a group of four has no weight
        self.weight.iter_mut().skip(self.count).for_each(|weight| *weight = 0.0);
        let rows = self.rows.each_ref().map(<[f64; N]>::as_slice);
        let factors = |j: usize| {
            let mut factors = self.weight;
            factors.iter_mut().zip(&rows).for_each(|(w, row)| *w *= row.get(j).copied().unwrap_or(0.0));
            factors
        };
        information.add_products(factors, rows);
        self.count = 0;
    }
}
