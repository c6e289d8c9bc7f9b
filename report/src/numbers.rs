//! What a figure shows, as CSV.

use super::axes::Axes;
use super::series::Series;

/// Rows under a header.
pub fn csv<const N: usize>(header: [&str; N], rows: impl IntoIterator<Item = [String; N]>) -> String {
    let mut writer = csv::Writer::from_writer(Vec::new());
    writer.write_record(header).expect("memory takes every row");
    for row in rows {
        writer.write_record(row).expect("memory takes every row");
    }
    let bytes = writer.into_inner().expect("memory takes every row");
    String::from_utf8(bytes).expect("rows of text are text")
}

/// The shortest figures that give the same number again.
pub fn number(value: f64) -> String {
    format!("{value:?}")
}

/// One row per point of some series.
pub fn of_series(axes: &Axes, series: &[Series]) -> String {
    csv(["series", "x", "y", "low", "high"], series.iter().flat_map(|one| rows(axes, one)))
}

/// Rows of one series: label, x or its name, y, bounds if there are any.
pub fn rows<'a>(axes: &'a Axes, series: &'a Series) -> impl Iterator<Item = [String; 5]> + 'a {
    let place = |x: f64| axes.x_names.get(x.round() as usize).cloned().unwrap_or_else(|| number(x));
    series.x.iter().zip(&series.y).enumerate().map(move |(index, (&x, &y))| {
        let [low, high] = match &series.band {
            Some(band) => [number(band[index].0), number(band[index].1)],
            None => [String::new(), String::new()],
        };
        [series.label.clone(), place(x), number(y), low, high]
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_may_hold_commas() {
        assert_eq!(csv(["a", "b"], [["x, y".into(), number(1e-9)]]), "a,b\n\"x, y\",1e-9\n");
    }

    #[test]
    fn names_stand_for_their_places() {
        let axes = Axes::default().named(&["A1".into(), "A2".into()]);
        let csv = of_series(&axes, &[Series::line("s", vec![1.0], vec![0.5])]);
        assert_eq!(csv, "series,x,y,low,high\ns,A2,0.5,,\n");
    }
}
