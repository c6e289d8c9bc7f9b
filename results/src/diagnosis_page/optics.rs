//! The optics of the machine that was fitted, against the design's, in the units of a control room.
//!
//! Error bars are those of everything that the fit may change in the ring: with `C` the covariance of those unknowns and `J` the derivatives
//! of an optics function, `sigma^2 = J C J^T`.

use diagnosis::{Data, Diagnosis, FitError, Fitted, Quantity, Unknown};
use nalgebra::{DMatrix, DVector};
use report::{Axes, Figure, Reference, Section, Series};
use twin::{Class, EffectError, Hold, Optics, Tunes, Twiss};

use super::lattice::{STRIP, strip};
use super::{table, tunes};

/// Step of an unknown for a derivative, in prior standard deviations.
const STEP: f64 = 0.05;

/// Optics functions at the entrance of every element and at the end of the ring, tunes, closest approach of these.
struct Functions {
    twiss: Vec<Twiss>,
    tunes: Tunes,
    approach: f64,
}

/// The fitted machine's against the design's, all with their standard deviations.
struct Fit {
    s: Vec<f64>,
    /// Relative change of the beta functions, and change of the dispersion [m].
    beat: [Vec<(f64, f64)>; 2],
    dispersion: [Vec<(f64, f64)>; 2],
    tunes: [(f64, f64); 2],
    approach: (f64, f64),
    design: Functions,
}

impl Functions {
    fn of(optics: &Optics) -> Result<Self, EffectError> {
        Ok(Self { twiss: optics.twiss()?, tunes: optics.tunes()?, approach: optics.closest_tune_approach()? })
    }

    /// Beta-beats and change of the dispersion in x and y at each place, then the tunes and their closest approach.
    fn against(&self, design: &Self) -> DVector<f64> {
        let of = |(one, design): (&Twiss, &Twiss)| {
            let [x, y] = one.beta_beat(design);
            [x, y, one.dispersion[0] - design.dispersion[0], one.dispersion[1] - design.dispersion[1]]
        };
        let mut all: Vec<f64> = self.twiss.iter().zip(&design.twiss).flat_map(of).collect();
        all.extend([self.tunes.x, self.tunes.y, self.approach]);
        DVector::from_vec(all)
    }
}

impl Fit {
    fn of(data: &Data, fitted: &Fitted) -> Result<Self, FitError> {
        let vars = fitted.params.len();
        let design = Functions::of(&Optics::of(&data.ring, Hold::Momentum { delta: 0.0 })?)?;
        let at = |u: &DVector<f64>| -> Result<DVector<f64>, EffectError> {
            let (machine, drives) =
                fitted.hypothesis.machine(data, 0, &fitted.units.params(u), &u.as_slice()[vars..])?;
            Ok(Functions::of(&machine.on_orbit(&drives.orbit).optics()?)?.against(&design))
        };
        let best = at(&fitted.u)?;
        let unknowns = fitted.hypothesis.unknowns(data);
        let moves = |unknown: &Unknown| match &unknown.quantity {
            Quantity::Amplitude(term) => moves_optics(term.kind),
            Quantity::Ordinary(member) => member.terms.first().is_some_and(|term| moves_optics(term.kind)),
            // of first order, it is not in the machine
            Quantity::Form(..) => false,
            // on which sextupoles focus
            Quantity::Orbit(..) => true,
        };
        let free: Vec<usize> =
            (0..vars).chain((0..unknowns.len()).filter(|&i| moves(&unknowns[i])).map(|i| vars + i)).collect();
        let mut slopes = DMatrix::zeros(best.len(), free.len());
        for (column, &i) in free.iter().enumerate() {
            let mut u = fitted.u.clone();
            u[i] += STEP;
            slopes.set_column(column, &((at(&u)? - &best) / STEP));
        }
        let covariance = fitted.factor.inverse().select_rows(&free).select_columns(&free);
        let sigma = (&slopes * covariance).component_mul(&slopes).column_sum().map(|variance| variance.max(0.0).sqrt());
        Ok(Self::collect(data, &best, &sigma, design))
    }

    fn collect(data: &Data, best: &DVector<f64>, sigma: &DVector<f64>, design: Functions) -> Self {
        let places = design.twiss.len();
        let pair = |i: usize| (best[i], sigma[i]);
        let of = |part: usize| (0..places).map(|place| pair(4 * place + part)).collect::<Vec<_>>();
        let ring = &data.ring;
        let last = 4 * places;
        Self {
            s: ring.elements.iter().map(|element| element.s).chain([ring.circumference]).collect(),
            beat: [of(0), of(1)],
            dispersion: [of(2), of(3)],
            tunes: [0, 1].map(|plane| (best[last + plane] + data.tune_shift_of_orbit[plane], sigma[last + plane])),
            approach: pair(last + 2),
            design,
        }
    }

    /// A function along the beam with its error band, both times a factor.
    fn series(&self, label: &str, of: &[(f64, f64)], factor: f64) -> Series {
        let band = of.iter().map(|(value, sigma)| (factor * (value - sigma), factor * (value + sigma))).collect();
        Series::line(label, self.s.clone(), of.iter().map(|(value, _)| factor * value).collect()).within(band)
    }
}

/// True if a kind of effect changes the ring's optics: a field, or the momentum.
fn moves_optics(kind: twin::EffectKind) -> bool {
    matches!(kind.class(), Class::Field(_) | Class::Hold(_))
}

/// Tunes, beta-beat, dispersion and coupling.
///
/// # Errors
/// [`FitError`].
pub fn section(diagnosis: &Diagnosis) -> Result<Section, FitError> {
    let found = &diagnosis.found;
    let fit = Fit::of(found.best.data(&found.data), &found.best)?;
    let rms = |of: &[(f64, f64)]| (of.iter().map(|(v, _)| v * v).sum::<f64>() / of.len().max(1) as f64).sqrt();
    let beats = [0, 1].map(|plane| 100.0 * rms(&fit.beat[plane]));
    let largest = |of: &[(f64, f64)]| of.iter().map(|(v, _)| v.abs()).fold(0.0, f64::max);
    let change = 1e3 * largest(&fit.dispersion[0]);
    let lines = |axes: Axes, series: &[Series]| {
        Figure::lines(&axes.compared(Reference::Level(0.0)).along(strip(diagnosis)), series)
    };
    let beat = lines(
        Axes::new(
            &format!("Beta-beat against the design: {:.1} % rms in x, {:.1} % in y", beats[0], beats[1]),
            "s [m]",
            "change of beta [%]",
        ),
        &[fit.series("x", &fit.beat[0], 100.0), fit.series("y", &fit.beat[1], 100.0)],
    );
    let dispersion = lines(
        Axes::new(
            &format!("The dispersion differs from the design by {change:.0} mm at most in x"),
            "s [m]",
            "change of the dispersion [mm]",
        ),
        &[fit.series("x", &fit.dispersion[0], 1e3), fit.series("y", &fit.dispersion[1], 1e3)],
    );
    let without = if found.best.hypothesis.element.is_some() {
        " The unknown element is known to first order in its strengths only, and is not in it."
    } else {
        ""
    };
    Ok(Section {
        heading: "Optics of the fitted machine".into(),
        text: vec![format!(
            "The machine of the fit, with the effects found, against the design.{without} Error bands are one standard deviation: of the strengths, of the effects \
             and of what is ordinary together."
        )],
        figures: vec![
            (format!("Relative change of the beta functions of the projected planes. {STRIP}"), beat),
            (format!("Change of the dispersion; in y the design has none. {STRIP}"), dispersion),
        ],
        tables: vec![numbers(found.best.data(&found.data), &found.best, &fit)?],
    })
}

fn numbers(data: &Data, fitted: &Fitted, fit: &Fit) -> Result<report::Table, FitError> {
    let measured = |plane: usize| -> Result<String, FitError> {
        let mean = tunes::mean(data, fitted, plane)?;
        let without = if data.close_tunes.is_some() { "too close, not used" } else { "not measured" };
        Ok(mean.map_or(without.to_owned(), |(mean, sigma)| format!("{mean:.5} ± {sigma:.5}")))
    };
    let measured = [measured(0)?, measured(1)?];
    let design = [fit.design.tunes.x, fit.design.tunes.y];
    let tune = |plane: usize| {
        let (value, sigma) = fit.tunes[plane];
        [
            format!("tune {}", ["x", "y"][plane]),
            format!("{:.5}", design[plane]),
            format!("{value:.5} ± {sigma:.5}"),
            measured[plane].clone(),
        ]
    };
    let (approach, sigma) = fit.approach;
    let coupling = [
        "closest approach of the tunes [1e\u{2212}3]".into(),
        format!("{:.2}", 1e3 * fit.design.approach),
        format!("{:.2} ± {:.2}", 1e3 * approach, 1e3 * sigma),
        "not measured".into(),
    ];
    let beat = |plane: usize| {
        let most = fit.beat[plane]
            .iter()
            .fold((0.0_f64, 0.0), |most, one| if one.0.abs() > most.0.abs() { *one } else { most });
        let value = format!("{} ± {:.1}", super::signed(100.0 * most.0, 1), 100.0 * most.1);
        [format!("largest beta-beat in {} [%]", ["x", "y"][plane]), "0".into(), value, "not measured".into()]
    };
    let caption = "Optics of the design (at the recording's supply currents), of the fitted machine, and as measured by the tune meter. The closest approach is \
                   what skew gradients and rolls leave between the tunes, were these brought together. The orbit in sextupole fields of the design is in the tunes, not in the other rows.";
    Ok(table(caption, ["", "design", "fitted", "measured"], vec![tune(0), tune(1), coupling, beat(0), beat(1)]))
}
