//! All frames so far, counted into a second Gaussian at a new linearisation, a slice at a time.

use super::{Estimator, Loose, Model, Tangent, about, follow};
use crate::drive::Drive;
use crate::following;
use crate::gaussian::{Gaussian, Independent, Line, Pool, Repeats};
use crate::judged::Screened;
use crate::linear::dot;
use crate::mask::Mask;
use crate::surrogate::Surrogate;
use crate::wire::{Frame, PositionCode};

/// Settings that are counted in one slice.
const TOGETHER: usize = 16;

/// How far counting has come.
#[derive(Debug, Clone)]
pub(super) struct Pooling<const S: usize, const K: usize, const N: usize, const T: usize> {
    /// It has begun: what comes now may come late.
    is_open: bool,
    /// Settings that are counted.
    settings: [bool; S],
    /// How many of the recent frames are, from the oldest on.
    recent: usize,
    /// Chi-square of late repeats about the means of their settings: these frames count one by one, and not as repeats.
    late_scatter: f64,
    /// What has been counted.
    pub gaussian: Gaussian<K, N, T, Independent<K, f64>>,
    pool: Pool<K>,
}

impl<const S: usize, const K: usize, const N: usize, const T: usize> Pooling<S, K, N, T> {
    /// Memory for one, all zero: nothing counted.
    pub const BLANK: Self = Self {
        is_open: false,
        settings: [false; S],
        recent: 0,
        late_scatter: 0.0,
        gaussian: Gaussian::BLANK,
        pool: Pool::BLANK,
    };
}

/// Work space of each step: they are not needed at once.
#[derive(Debug, Clone)]
#[allow(clippy::large_enum_variant)] // there is no allocator; and both are large
pub(super) enum Work<P, const S: usize, const K: usize, const N: usize, const T: usize> {
    /// All frames so far are counted.
    Past(Pooling<S, K, N, T>),
    /// The surrogate is linearised.
    Surrogate(P),
    /// How orbits follow the gradients is worked out, in this plane next.
    Following(usize),
}

/// A frame that came late.
#[derive(Debug, Clone)]
pub(super) struct Late<const B: usize, const C: usize, const F: usize, const W: usize> {
    drive: Drive<C, F>,
    /// What each reading adds to those counted before it, as one of its own [m], and its variance [m^2].
    news: [(f32, f32); B],
    accepted: Mask<W>,
    /// First channel of its baselines.
    first_channel: u16,
}

impl<
    G: Surrogate<B, C, F, N>,
    const B: usize,
    const C: usize,
    const F: usize,
    const N: usize,
    const S: usize,
    const K: usize,
    const T: usize,
    const U: usize,
    const W: usize,
> Estimator<G, B, C, F, N, S, K, T, U, W>
{
    /// Count the next part: late frames first, so that there is room for others. False if nothing is left.
    pub(super) fn pool_next(&mut self, model: &Model<'_, G, B, C, F>) -> bool {
        if let Some(late) = self.anew.late.pop_front() {
            self.pool_frame(model, &late);
            return true;
        }
        let Work::Past(pooling) = &mut self.anew.work else { return false };
        if !pooling.is_open {
            self.open_pool();
            return true;
        }
        let known = pooling.settings.iter().take(self.past.campaign.cells().len());
        if let Some(first) = known.into_iter().position(|counted| !counted) {
            self.pool_kind(model, first);
            return true;
        }
        if let Some(frame) = self.past.recent.iter().nth(pooling.recent) {
            pooling.recent += 1;
            let frame = self.by_itself(model, frame);
            self.pool_frame(model, &frame);
            return true;
        }
        false
    }

    /// Begin with the prior, and with frames that cannot be linearised anew.
    #[inline(never)]
    fn open_pool(&mut self) {
        let Work::Past(pooling) = &mut self.anew.work else { return };
        let level = self.posterior.gaussian.baselines_at(&self.anew.to);
        (pooling.is_open, pooling.settings, pooling.recent, pooling.late_scatter) = (true, [false; S], 0, 0.0);
        pooling.gaussian.copy(&self.past.loose);
        pooling.gaussian.recentre(&self.anew.to);
        pooling.gaussian.open(&mut pooling.pool, level);
    }

    /// Begin anew: what has been counted has changed.
    pub(super) fn reopen_pool(&mut self) {
        self.anew.late.clear();
        if let Work::Past(pooling) = &mut self.anew.work {
            pooling.is_open = false;
        }
    }

    /// Count settings of one kind.
    ///
    /// They differ by the powered corrector's current, so that one derivative serves them all. The 20 mA by which idle
    /// correctors scatter count in the orbit and not in its derivative, a thousandth of it.
    #[inline(never)]
    fn pool_kind(&mut self, model: &Model<'_, G, B, C, F>, first: usize) {
        let Tangent { linearised, supplies, .. } = &self.anew.tangent;
        let from_here = self.past.campaign.cells().iter().zip(0..).skip(first);
        let Some((first, _)) = from_here.clone().next() else { return };
        model.surrogate.predict(linearised, &self.believed(&first.alone()), &mut self.predicted.prediction);
        let by_supply = self.predicted.prediction.by_supply;
        let first_channel = self.first_channel(first.cycle_time());
        let mut lines = [Line::default(); B];
        for (cell, index) in from_here.filter(|(cell, _)| cell.is_kind_of(first)).take(TOGETHER) {
            let Work::Past(pooling) = &mut self.anew.work else { return };
            if pooling.settings.get_mut(index).is_none_or(|counted| core::mem::replace(counted, true)) {
                continue;
            }
            let (drive, share) = (self.believed(&cell.drive()), cell.share(first));
            let strength = about(&drive, supplies).strength;
            let direct = Drive { strength: [0.0; F], ..drive };
            model.surrogate.orbit(linearised, &direct, &mut self.predicted.prediction.reading);
            let repeats: [Repeats; B] = core::array::from_fn(|b| {
                let number = cell.mean(b).1;
                let variance = self.variance(model, &self.anew.tangent, b, number, drive.rf_offset);
                Repeats { number, noise: self.noise_variance(b), variance }
            });
            let Work::Past(Pooling { gaussian, pool, .. }) = &mut self.anew.work else { return };
            let level = pool.level.iter().skip(first_channel);
            let each = lines.iter_mut().zip(&repeats).zip(by_supply.iter().zip(level)).zip(&self.following);
            for (b, (((line, repeats), (by_supply, level)), following)) in each.enumerate() {
                let (Some(orbit), 1..) = (self.predicted.prediction.reading.get(b), repeats.number) else { continue };
                let orbit = orbit + share * dot(&strength, by_supply) + following.shift(&strength);
                let residual = f64::from(cell.mean(b).0 - orbit) - level;
                gaussian.count(line, share, residual, repeats);
            }
        }
        if let Work::Past(Pooling { gaussian, pool, .. }) = &mut self.anew.work {
            gaussian.add_lines(pool, first_channel, &lines, self.predicted.prediction.jacobian.as_slice());
        }
    }

    /// Count a frame by itself.
    #[inline(never)]
    fn pool_frame(&mut self, model: &Model<'_, G, B, C, F>, frame: &Late<B, C, F, W>) {
        let Tangent { linearised, supplies, .. } = &self.anew.tangent;
        let drive = about(&self.believed(&frame.drive), supplies);
        model.surrogate.predict(linearised, &drive, &mut self.predicted.prediction);
        follow(&self.following, &drive.strength, &mut self.predicted.prediction.reading);
        let Work::Past(Pooling { gaussian, pool, .. }) = &mut self.anew.work else { return };
        let mut lines = [Line::default(); B];
        let first_channel = usize::from(frame.first_channel);
        let level = pool.level.iter().skip(first_channel);
        let each = lines.iter_mut().zip(&frame.news).zip(self.predicted.prediction.reading.iter().zip(level));
        for (_, ((line, (reading, variance)), (predicted, level))) in
            each.enumerate().filter(|(b, _)| frame.accepted.has(*b))
        {
            let residual = f64::from(reading - predicted) - level;
            gaussian.count(line, 1.0, residual, &Repeats { number: 1, noise: *variance, variance: *variance });
        }
        gaussian.add_lines(pool, first_channel, &lines, self.predicted.prediction.jacobian.as_slice());
    }

    /// Eliminate the baselines, and count what is known of all frames together.
    #[inline(never)]
    pub(super) fn finish_pooling(&mut self, model: &Model<'_, G, B, C, F>) {
        let expected: [following::Expected<F>; B] = core::array::from_fn(|b| self.follows(model, b));
        let Work::Past(Pooling { gaussian, pool, late_scatter, .. }) = &mut self.anew.work else { return };
        gaussian.close(pool);
        gaussian.add_scatter(-*late_scatter, 0.0);
        for (following, expected) in self.following.iter().zip(&expected) {
            gaussian.add_scatter(following.chi_square(expected), following.volume(expected));
        }
        self.count_tunes(model);
    }

    /// A frame of a setting that is counted already is late.
    pub(super) fn note_late(
        &mut self,
        model: &Model<'_, G, B, C, F>,
        frame: &Frame<B, C, F, W>,
        drive: &Drive<C, F>,
        cell: u16,
        screened: &Screened<W>,
    ) {
        let is_counted = |pooling: &Pooling<S, K, N, T>| pooling.settings.get(usize::from(cell)) == Some(&true);
        match &mut self.anew.work {
            Work::Past(pooling) if self.anew.under_way && pooling.is_open && is_counted(pooling) => {
                pooling.late_scatter += screened.scatter;
            }
            _ => return,
        }
        let news = |b| {
            let reading = frame.reading.get(b).map_or(0.0, |reading: &PositionCode| reading.value());
            self.news_of(model, b, reading, Some(cell))
        };
        let first_channel = self.predicted.first_channel as u16;
        let late = Late { drive: *drive, news: core::array::from_fn(news), accepted: screened.accepted, first_channel };
        self.await_count(late);
    }

    /// A recent frame leaves the recent ones: it is late if it is not counted yet.
    pub(super) fn note_leaving(&mut self, model: &Model<'_, G, B, C, F>, frame: &Loose<B, C, F, W>) {
        match &mut self.anew.work {
            Work::Past(pooling) if self.anew.under_way && pooling.is_open => match &mut pooling.recent {
                0 => self.await_count(self.by_itself(model, frame)),
                counted => *counted -= 1,
            },
            _ => {}
        }
    }

    /// A recent frame that says nothing is dropped: those after it move up.
    pub(super) fn note_dropped(&mut self, at: usize) {
        if let Work::Past(pooling) = &mut self.anew.work {
            pooling.recent -= usize::from(at < pooling.recent);
        }
    }

    /// Let a late frame wait for the next slice. When as many as there is room for wait, all is counted anew instead.
    fn await_count(&mut self, late: Late<B, C, F, W>) {
        if self.anew.late.push_back(late).is_err() {
            self.reopen_pool();
        }
    }

    fn by_itself(&self, model: &Model<'_, G, B, C, F>, frame: &Loose<B, C, F, W>) -> Late<B, C, F, W> {
        let reading = |b| frame.reading.get(b).map_or(0.0, |reading: &PositionCode| reading.value());
        let drive = about(&frame.drive, &self.anew.tangent.supplies);
        let news = |b| (reading(b), self.variance_at(model, &self.anew.tangent, b, &drive));
        let (accepted, first_channel) = (frame.accepted, frame.first_channel);
        Late { drive: frame.drive, news: core::array::from_fn(news), accepted, first_channel }
    }
}
