//! Tables as Rust, for an image that has them in its flash.

use core::fmt::Write as _;

use estimator::surrogate::{List, Table};

use crate::tables::Tables;

impl Tables {
    /// The sizes of this ring as a call of [`estimator::machine!`].
    pub fn machine_source(&self) -> String {
        let [bx, by, cx, cy, quadrupoles, params, supplies] = self.sizes().all();
        format!(
            "estimator::machine!(monitors: [{bx}, {by}], correctors: [{cx}, {cy}], quadrupoles: {quadrupoles}, \
             params: {params}, supplies: {supplies});"
        )
    }

    /// The tables as a value of a surrogate of exactly these sizes, ready for use. Floats are written with the digits that
    /// read back to the same bits.
    ///
    /// # Panics
    /// If they have terms of low rank: those of a ring as designed have none.
    pub fn source(&self) -> String {
        assert_eq!(self.terms(), 0, "a ring as designed needs none");
        let &[sx, sy, compaction, inverse, circumference, tune_x, tune_y, error_x, error_y] = self.list(List::Ring)
        else {
            unreachable!("the list has nine numbers");
        };
        let [bx, by, cx, cy, quadrupoles, params, supplies] = self.sizes().all();
        let planes = [
            ("x", 0, [Table::DirectX, Table::SeenX, Table::DrivenX], Table::MutualX),
            ("y", 4, [Table::DirectY, Table::SeenY, Table::DrivenY], Table::MutualY),
        ];
        let mut text = format!(
            "Green {{ sizes: Sizes::new([{bx}, {by}], [{cx}, {cy}], [{quadrupoles}, {params}, {supplies}]), low_rank: \
             LowRank::BLANK, tune: [{tune_x:?}, {tune_y:?}], stated_error: [{error_x:?}, {error_y:?}], dispersion: \
             Dispersion {{ monitor: {:?}, node: {:?}, second_order: {:?}, spurious: [{sx:?}, {sy:?}], compaction: \
             {compaction:?}, inverse_gamma_squared: {inverse:?}, circumference: {circumference:?} }}, weight: {:?}, \
             param: {:?}, supply: {:?}, group: {:?}",
            self.list(List::MonitorDispersion),
            self.list(List::NodeDispersion),
            self.list(List::SecondOrder),
            self.list(List::Weight),
            self.lines(Table::Param)[0],
            self.lines(Table::Supply)[0],
            self.lines(Table::Group)[0],
        );
        for (name, first, blocks, mutual) in planes {
            let steps = &self.list(List::Steps)[first..];
            let fields = ["direct", "seen", "driven"].into_iter().zip(blocks).zip(steps);
            write!(text, ", {name}: GreenPlane {{ ").expect("a string takes all");
            for ((field, table), scale) in fields {
                let codes = self.lines(table);
                write!(text, "{field}: Block {{ scale: {scale:?}, codes: {codes:?} }}, ").expect("a string takes all");
            }
            let (scale, codes) = (steps[3], self.lines(mutual).concat());
            write!(text, "mutual: SymmetricBlock {{ scale: {scale:?}, codes: {codes:?} }} }}")
                .expect("a string takes all");
        }
        text + " }"
    }
}
