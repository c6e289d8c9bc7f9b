//! A ring seen from above: its magnets and instruments, and what was found where.

use core::f64::consts::TAU;

use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

use super::beamline::{Look, Magnet, Spotted, Symbol};
use super::canvas::{Drawn, NARROW, SMALL, Sheet, TICK, TITLE, bold, draw, plain, px, write};
use super::figure::Figure;
use super::numbers::{csv, number};
use super::pen::{Pen, Spot};

/// Radius of the beam's path, of the half-cells' names, of the superperiods' names, and of marks of what was found [px].
const RADIUS: f64 = 218.0;
const NAMES: f64 = 190.0;
const SECTORS: f64 = 160.0;
const MARKS: f64 = 246.0;
/// Radius and horizontal distance from the centre at which labels hang, and the space each takes [px].
const LABELS: f64 = 262.0;
const SIDE: f64 = 270.0;
const LINE: f64 = 16.0;
/// Factor of all radii on a phone.
const SMALLER: f64 = 0.7;

const INK: RGBColor = RGBColor(60, 60, 60);
const PALE: RGBColor = RGBColor(150, 150, 150);

/// A ring.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RingMap {
    /// Title above the figure.
    pub title: String,
    /// Length of the beam's path [m].
    pub circumference: f64,
    /// Names inside the path, and where each stands [m].
    pub names: Vec<(String, f64)>,
    /// Superperiods and where each begins [m].
    pub sectors: Vec<(String, f64)>,
    /// Magnets and instruments.
    pub magnets: Vec<Magnet>,
    /// What to point at.
    pub spotted: Vec<Spotted>,
    /// Lines in the middle, for what is not at one place.
    pub everywhere: Vec<String>,
}

impl Figure {
    /// The ring with s = 0 at the top and the beam going round clockwise.
    pub fn ring_map(map: &RingMap) -> Figure {
        let rows = map.spotted.iter().map(|one| [one.label.clone(), one.look.word().to_owned(), number(one.s)]);
        let csv = csv(["label", "look", "s_m"], rows);
        Figure::drawn(csv, |width| chart(map, width))
    }
}

/// The whole map; on a phone smaller, with the labels listed below it.
fn chart(map: &RingMap, width: f64) -> String {
    let narrow = width <= NARROW;
    let scale = if narrow { SMALLER } else { 1.0 };
    let centre = (0.5 * width, TITLE + 266.0 * scale);
    let listed = if narrow { LINE * (map.spotted.len() + map.everywhere.len()) as f64 } else { 0.0 };
    let below = centre.1 + 270.0 * scale;
    draw(&map.title, (width, below + listed), |sheet| {
        let ring = Round { sheet, circumference: map.circumference.max(f64::MIN_POSITIVE), centre, scale };
        ring.path()?;
        map.sectors.iter().enumerate().try_for_each(|(i, (name, s))| {
            let next = map.sectors.get(i + 1).map_or(map.circumference, |(_, s)| *s);
            ring.sector(name, *s, next)
        })?;
        map.names.iter().try_for_each(|(name, s)| ring.text(name, *s, NAMES, &plain(10.0, HPos::Center)))?;
        map.magnets.iter().try_for_each(|magnet| ring.magnet(magnet))?;
        ring.key()?;
        if narrow {
            return ring.list(map, below);
        }
        ring.pointers(&map.spotted)?;
        let first = centre.1 + 78.0;
        map.everywhere.iter().enumerate().try_for_each(|(i, line)| {
            write(sheet, line, (centre.0, first + LINE * i as f64), &bold(TICK, HPos::Center))
        })
    })
}

/// The ring on its sheet.
struct Round<'s, 'a> {
    sheet: &'s Sheet<'a>,
    circumference: f64,
    /// Centre [px], and factor of all radii.
    centre: (f64, f64),
    scale: f64,
}

impl Round<'_, '_> {
    /// A place [px].
    fn at(&self, s: f64, radius: f64) -> (f64, f64) {
        let (angle, radius) = (TAU * s / self.circumference, radius * self.scale);
        (self.centre.0 + radius * angle.sin(), self.centre.1 - radius * angle.cos())
    }

    fn spot(&self, s: f64, radius: f64) -> Spot {
        let (x, y) = self.at(s, radius);
        (px(x), px(y))
    }

    fn line(&self, spots: Vec<Spot>, colour: RGBColor, width: f64) -> Drawn {
        self.sheet.draw(&PathElement::new(spots, colour.stroke_width(px(width) as u32)))
    }

    fn arc(&self, from: f64, to: f64, radius: f64, colour: RGBColor, width: f64) -> Drawn {
        let steps = ((to - from) / self.circumference * 360.0).ceil().max(2.0) as usize;
        let spot = |i: usize| self.spot(from + (to - from) * i as f64 / steps as f64, radius);
        self.line((0..=steps).map(spot).collect(), colour, width)
    }

    fn text(&self, text: &str, s: f64, radius: f64, style: &TextStyle) -> Drawn {
        write(self.sheet, text, self.at(s, radius), style)
    }

    fn path(&self) -> Drawn {
        self.arc(0.0, self.circumference, RADIUS, PALE, 1.0)
    }

    fn sector(&self, name: &str, from: f64, to: f64) -> Drawn {
        self.line(vec![self.spot(from, SECTORS - 14.0), self.spot(from, NAMES - 10.0)], PALE, 0.8)?;
        self.text(name, 0.5 * (from + to), SECTORS, &bold(17.0, HPos::Center))
    }

    fn magnet(&self, magnet: &Magnet) -> Drawn {
        let middle = magnet.s + 0.5 * magnet.length;
        match magnet.symbol {
            Symbol::Bend => self.arc(magnet.s, magnet.s + magnet.length, RADIUS, PALE, 6.0),
            Symbol::Focusing => {
                self.line(vec![self.spot(middle, RADIUS - 4.0), self.spot(middle, RADIUS + 11.0)], INK, 3.0)
            }
            Symbol::Defocusing => {
                self.line(vec![self.spot(middle, RADIUS - 11.0), self.spot(middle, RADIUS + 4.0)], INK, 3.0)
            }
            Symbol::Monitor => self.dot(self.spot(middle, RADIUS + 16.0)),
            Symbol::UnreadMonitor => self.hollow(self.spot(middle, RADIUS + 16.0)),
            Symbol::Sextupole => self.diamond(self.spot(middle, RADIUS)),
            Symbol::Corrector => {
                let wide = 0.9 * self.circumference / 360.0;
                let corners = vec![
                    self.spot(middle, RADIUS - 5.0),
                    self.spot(middle - wide, RADIUS - 12.0),
                    self.spot(middle + wide, RADIUS - 12.0),
                ];
                self.sheet.draw(&Polygon::new(corners, INK.filled()))
            }
        }
    }

    fn dot(&self, spot: Spot) -> Drawn {
        self.sheet.draw(&Circle::new(spot, px(2.2), INK.filled()))
    }

    fn hollow(&self, spot: Spot) -> Drawn {
        self.sheet.draw(&Circle::new(spot, px(2.4), INK.stroke_width(px(0.9) as u32)))
    }

    fn diamond(&self, (x, y): Spot) -> Drawn {
        let half = px(3.6);
        self.sheet.draw(&Polygon::new(vec![(x, y - half), (x + half, y), (x, y + half), (x - half, y)], INK.filled()))
    }

    /// What the symbols mean, in the middle.
    fn key(&self) -> Drawn {
        let (x, top) = (self.centre.0 - 82.0, self.centre.1 - 70.0);
        let at = |dx: f64, line: usize, dy: f64| (px(x + dx), px(top + LINE * line as f64 + dy));
        let texts = [
            "s = 0 at the top, beam clockwise",
            "dipole",
            "quadrupole, focusing in x",
            "quadrupole, defocusing in x",
            "monitor; hollow: not read",
            "corrector",
            "sextupole",
        ];
        self.line(vec![at(0.0, 1, 0.0), at(14.0, 1, 0.0)], PALE, 6.0)?;
        for (line, shift) in [(2, -2.5), (3, 2.5)] {
            self.line(vec![at(0.0, line, 0.0), at(14.0, line, 0.0)], PALE, 1.0)?;
            self.line(vec![at(7.0, line, shift - 5.5), at(7.0, line, shift + 5.5)], INK, 3.0)?;
        }
        self.dot(at(3.5, 4, 0.0))?;
        self.hollow(at(11.0, 4, 0.0))?;
        self.diamond(at(7.0, 6, 0.0))?;
        let corners = vec![at(7.0, 5, -4.0), at(3.0, 5, 4.0), at(11.0, 5, 4.0)];
        self.sheet.draw(&Polygon::new(corners, INK.filled()))?;
        texts.into_iter().enumerate().try_for_each(|(line, text)| {
            let left = if line == 0 { x } else { x + 22.0 };
            write(self.sheet, text, (left, top + LINE * line as f64), &plain(SMALL, HPos::Left))
        })
    }

    /// A mark at each place, and its label on the nearer side, none over another.
    fn pointers(&self, spotted: &[Spotted]) -> Drawn {
        for right in [true, false] {
            let here = |one: &&Spotted| (self.at(one.s, 1.0).0 >= self.centre.0) == right;
            let mut side: Vec<&Spotted> = spotted.iter().filter(here).collect();
            side.sort_by(|one, other| self.at(one.s, LABELS).1.total_cmp(&self.at(other.s, LABELS).1));
            let wanted: Vec<f64> = side.iter().map(|one| self.at(one.s, LABELS).1).collect();
            // pale ones first: what was found lies on top
            let mut order: Vec<(usize, f64)> = spread(&wanted).into_iter().enumerate().collect();
            order.sort_by_key(|(i, _)| side[*i].look != Look::Alternative);
            order.into_iter().try_for_each(|(i, height)| self.pointer(side[i], right, height))?;
        }
        Ok(())
    }

    fn cross(&self, (x, y): Spot) -> Drawn {
        let half = px(3.6);
        [1, -1].into_iter().try_for_each(|turn| {
            let ends = [(x - half, y - turn * half), (x + half, y + turn * half)];
            self.sheet.draw(&PathElement::new(ends, INK.stroke_width(px(1.8) as u32)))
        })
    }

    fn pointer(&self, one: &Spotted, right: bool, height: f64) -> Drawn {
        let (turn, anchor) = if right { (1.0, HPos::Left) } else { (-1.0, HPos::Right) };
        let mark = self.spot(one.s, MARKS);
        let label = self.centre.0 + turn * SIDE;
        let (colour, width) = if one.look == Look::Finding { (INK, 1.2) } else { (PALE, 0.8) };
        let bent = (px(self.centre.0 + turn * (SIDE - 8.0)), px(height));
        self.line(vec![self.spot(one.s, RADIUS), mark, bent, (px(label - turn * 2.0), px(height))], colour, width)?;
        self.mark(one.look, mark)?;
        write(self.sheet, &one.label, (label + turn * 2.0, height), &style(one.look, anchor))
    }

    fn mark(&self, look: Look, at: Spot) -> Drawn {
        match look {
            Look::Alternative => {
                self.sheet.draw(&Circle::new(at, px(4.0), WHITE.filled()))?;
                self.sheet.draw(&Circle::new(at, px(4.0), PALE.stroke_width(px(1.4) as u32)))
            }
            Look::Finding => Pen::nth(1).mark(self.sheet, at),
            Look::Faulty => self.cross(at),
        }
    }

    /// The marks, and below the ring what each is, findings first.
    fn list(&self, map: &RingMap, top: f64) -> Drawn {
        let mut spotted: Vec<&Spotted> = map.spotted.iter().collect();
        spotted.sort_by_key(|one| one.look);
        let row = |i: usize| top + LINE * (i as f64 - 0.5);
        for (i, one) in spotted.iter().enumerate().rev() {
            self.line(vec![self.spot(one.s, RADIUS), self.spot(one.s, MARKS)], PALE, 0.8)?;
            self.mark(one.look, self.spot(one.s, MARKS))?;
            self.mark(one.look, (px(16.0), px(row(i))))?;
            let label = format!("{}, s = {:.1} m", one.label, one.s);
            write(self.sheet, &label, (28.0, row(i)), &style(one.look, HPos::Left))?;
        }
        map.everywhere
            .iter()
            .enumerate()
            .try_for_each(|(i, line)| write(self.sheet, line, (28.0, row(spotted.len() + i)), &bold(TICK, HPos::Left)))
    }
}

/// Style of a label.
fn style(look: Look, anchor: HPos) -> TextStyle<'static> {
    match look {
        Look::Alternative => plain(SMALL, anchor).color(&RGBColor(90, 90, 90)),
        Look::Finding => bold(TICK, anchor),
        Look::Faulty => plain(TICK, anchor),
    }
}

/// Heights in order, moved apart until each has its line.
fn spread(wanted: &[f64]) -> Vec<f64> {
    let (top, bottom) = (TITLE + 8.0, TITLE + 528.0);
    let mut heights = wanted.to_vec();
    for _ in 0..200 {
        for i in 1..heights.len() {
            let overlap = LINE - (heights[i] - heights[i - 1]);
            if overlap > 0.0 {
                heights[i - 1] -= 0.5 * overlap;
                heights[i] += 0.5 * overlap;
            }
        }
        heights.iter_mut().for_each(|height| *height = height.clamp(top, bottom));
    }
    heights
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_keep_their_order_and_their_distance() {
        let heights = spread(&[300.0, 301.0, 301.0, 302.0, 500.0]);
        assert!(heights.windows(2).all(|pair| pair[1] - pair[0] > LINE - 0.5), "{heights:?}");
        assert_eq!(heights[4], 500.0);
    }

    #[test]
    fn what_was_found_is_named_on_the_map() {
        let map = RingMap {
            title: "t".into(),
            circumference: 200.0,
            names: vec![("A1".into(), 2.0)],
            sectors: vec![("A".into(), 0.0), ("B".into(), 100.0)],
            magnets: vec![Magnet { symbol: Symbol::Focusing, s: 3.0, length: 0.5 }],
            spotted: vec![Spotted { label: "gain x_E4".into(), s: 150.0, look: Look::Finding }],
            everywhere: vec!["drift".into()],
        };
        let figure = Figure::ring_map(&map);
        assert!(
            ["gain x_E4", "A", "B", "A1", "drift"]
                .iter()
                .all(|text| figure.svg.contains(&format!(">\n{text}\n</text>")))
        );
        assert_eq!(figure.csv.lines().nth(1), Some("gain x_E4,finding,150.0"));
    }
}
