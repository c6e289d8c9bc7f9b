//! Sums and products of a stream, which must not lose digits however long it lasts.

/// A sum of many small terms, compensated, so that months of frames lose nothing.
///
/// Source: A. Neumaier, ZAMM 54 (1974) 39.
#[derive(Debug, Clone, Copy, Default)]
pub struct Sum {
    total: f32,
    lost: f32,
}

impl Sum {
    /// Nothing yet.
    pub const ZERO: Self = Self { total: 0.0, lost: 0.0 };

    /// Add a term.
    pub fn add(&mut self, term: f32) {
        let total = self.total + term;
        self.lost +=
            if self.total.abs() >= term.abs() { (self.total - total) + term } else { (term - total) + self.total };
        self.total = total;
    }

    /// The sum.
    pub fn value(&self) -> f32 {
        self.total + self.lost
    }
}

/// The logarithm of a product of many factors near 1, with few logarithms taken.
#[derive(Debug, Clone, Copy)]
pub struct LogProduct {
    taken: Sum,
    product: f32,
}

impl LogProduct {
    /// The empty product.
    pub const ONE: Self = Self { taken: Sum::ZERO, product: 1.0 };
    /// All bits zero: no product yet, for memory that is cleared at start.
    pub const BLANK: Self = Self { taken: Sum::ZERO, product: 0.0 };

    /// Multiply by a factor.
    pub fn multiply(&mut self, factor: f32) {
        self.product *= factor;
        if !(1e-15..1e15).contains(&self.product) {
            self.taken.add(libm::logf(self.product));
            self.product = 1.0;
        }
    }

    /// Multiply by `exp(log)`.
    pub fn add_log(&mut self, log: f32) {
        self.taken.add(log);
    }

    /// The logarithm.
    pub fn value(&self) -> f32 {
        self.taken.value() + libm::logf(self.product)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn compensated_sums_lose_nothing() {
        let mut sum = Sum::default();
        sum.add(1e8);
        (0..1_000_000).for_each(|_| sum.add(1.0));
        assert_eq!(sum.value(), 1.01e8);
    }

    #[test]
    fn a_product_may_leave_the_range_of_its_type() {
        let mut product = LogProduct::ONE;
        (0..1000).for_each(|_| product.multiply(10.0));
        product.add_log(-2000.0 * core::f32::consts::LN_10);
        assert!((product.value() + 1000.0 * core::f32::consts::LN_10).abs() < 1e-3); // f32 rounding of 2303
    }
}
