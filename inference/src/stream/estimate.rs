//! The estimate of a core after a frame, for a ring of any size.

use estimator::wire::link::Answer;
use estimator::{Health, Layout, Mask, MonitorState, Remarks};
use training::rooms::largest;

/// The vars and the state of the monitors after a frame: [`estimator::Estimate`] without spare slots.
#[derive(Debug, Clone, PartialEq)]
#[allow(missing_docs)] // those of `estimator::Estimate`
pub struct Estimate {
    pub sequence: u32,
    pub time_us: u64,
    pub frames: u32,
    pub rejected_frames: u32,
    /// [N]
    pub mean: Vec<f32>,
    pub sigma: Vec<f32>,
    pub map_params: Vec<f32>,
    pub centre: Vec<f32>,
    pub params_sigma: Vec<f32>,
    pub clipped: Vec<bool>,
    pub nis: f32,
    /// [B]
    pub accepted: Vec<bool>,
    pub rejected: Vec<bool>,
    pub confirmed: Vec<bool>,
    pub restarted: Vec<bool>,
    pub tune_innovation: [Option<f32>; 2],
    pub setting: Option<u16>,
    pub log_evidence: f32,
    pub linearised: bool,
    pub remarks: Remarks,
    pub health: Vec<Health>,
}

impl Estimate {
    /// That of a core which has room for the ring.
    ///
    /// # Panics
    /// Never: every state of a monitor has a code.
    pub fn from_core<const B: usize, const N: usize, const W: usize>(
        estimate: &estimator::Estimate<B, N, W>,
        layout: &Layout,
    ) -> Self {
        let slots = (0..layout.monitors()).map(|b| layout.monitor(b));
        Self::picked(&estimate.into(), layout.params(), slots).expect("every state of a monitor has a code")
    }

    /// That of a device of any size, if every list of its reply is complete.
    pub fn of_answer(answer: &largest::Answer) -> Option<Self> {
        let (params, monitors) = (answer.mean.len(), answer.health.len());
        let lists = [&answer.sigma, &answer.map_params, &answer.centre, &answer.params_sigma];
        let masks = [&answer.accepted, &answer.rejected, &answer.confirmed, &answer.restarted];
        let is_whole = lists.iter().all(|list| list.len() == params)
            && masks.iter().all(|mask| mask.len() == estimator::words(monitors))
            && answer.clipped.len() == estimator::words(params);
        is_whole.then(|| Self::picked(answer, params, 0..monitors)).flatten()
    }

    /// The first params and the monitors of some slots; none if a state of a monitor is unknown.
    fn picked<const B: usize, const N: usize, const W: usize>(
        answer: &Answer<B, N, W>,
        params: usize,
        slots: impl Iterator<Item = usize> + Clone,
    ) -> Option<Self> {
        let first = |values: &[f32]| values[..params].to_vec();
        let monitors = |words: &[u32]| {
            let mask = Mask::<W>::from_words(words);
            slots.clone().map(|b| mask.has(b)).collect()
        };
        let clipped = Mask::<W>::from_words(&answer.clipped);
        let health = |b: usize| {
            let (state, noise, weighted_as, rejected) = answer.health[b];
            Some(Health { state: MonitorState::from_code(state)?, noise, weighted_as, rejected })
        };
        Some(Self {
            sequence: answer.sequence,
            time_us: answer.time_us,
            frames: answer.frames,
            rejected_frames: answer.rejected_frames,
            mean: first(&answer.mean),
            sigma: first(&answer.sigma),
            map_params: first(&answer.map_params),
            centre: first(&answer.centre),
            params_sigma: first(&answer.params_sigma),
            clipped: (0..params).map(|i| clipped.has(i)).collect(),
            nis: answer.nis,
            accepted: monitors(&answer.accepted),
            rejected: monitors(&answer.rejected),
            confirmed: monitors(&answer.confirmed),
            restarted: monitors(&answer.restarted),
            tune_innovation: answer.tune_innovation,
            setting: answer.setting,
            log_evidence: answer.log_evidence,
            linearised: answer.linearised,
            remarks: answer.remarks,
            health: slots.clone().map(health).collect::<Option<_>>()?,
        })
    }
}
