//! The estimate of a core after a frame, for a ring of any size.

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
    pub fn from_core<const B: usize, const N: usize, const W: usize>(
        e: &estimator::Estimate<B, N, W>,
        layout: &Layout,
    ) -> Self {
        let params = |values: &[f32; N]| values[..layout.params()].to_vec();
        let slots = (0..layout.monitors()).map(|b| layout.monitor(b));
        let monitors = |mask: &Mask<W>| slots.clone().map(|b| mask.has(b)).collect();
        Self {
            sequence: e.sequence,
            time_us: e.time_us,
            frames: e.frames,
            rejected_frames: e.rejected_frames,
            mean: params(&e.mean),
            sigma: params(&e.sigma),
            map_params: params(&e.map_params),
            centre: params(&e.centre),
            params_sigma: params(&e.params_sigma),
            clipped: (0..layout.params()).map(|i| e.clipped.has(i)).collect(),
            nis: e.nis,
            accepted: monitors(&e.accepted),
            rejected: monitors(&e.rejected),
            confirmed: monitors(&e.confirmed),
            restarted: monitors(&e.restarted),
            tune_innovation: e.tune_innovation,
            setting: e.setting,
            log_evidence: e.log_evidence,
            linearised: e.linearised,
            remarks: e.remarks,
            health: slots.clone().map(|b| e.health[b]).collect(),
        }
    }

    /// That of a device of any size, if every list of its reply is complete.
    pub fn of_answer(answer: &largest::Answer) -> Option<Self> {
        let (params, monitors) = (answer.mean.len(), answer.health.len());
        let lists = [&answer.sigma, &answer.map_params, &answer.centre, &answer.params_sigma];
        let masks = [&answer.accepted, &answer.rejected, &answer.confirmed, &answer.restarted];
        let is_whole = lists.iter().all(|list| list.len() == params)
            && masks.iter().all(|mask| mask.len() == estimator::words(monitors))
            && answer.clipped.len() == estimator::words(params);
        if !is_whole {
            return None;
        }
        let bits = |words: &[u32], count| {
            let mask = Mask::<{ largest::WORDS }>::from_words(words);
            (0..count).map(|i| mask.has(i)).collect::<Vec<bool>>()
        };
        let health = |&(state, noise, weighted_as, rejected): &(u8, f32, f32, u32)| {
            Some(Health { state: MonitorState::from_code(state)?, noise, weighted_as, rejected })
        };
        Some(Self {
            sequence: answer.sequence,
            time_us: answer.time_us,
            frames: answer.frames,
            rejected_frames: answer.rejected_frames,
            mean: answer.mean.to_vec(),
            sigma: answer.sigma.to_vec(),
            map_params: answer.map_params.to_vec(),
            centre: answer.centre.to_vec(),
            params_sigma: answer.params_sigma.to_vec(),
            clipped: bits(&answer.clipped, params),
            nis: answer.nis,
            accepted: bits(&answer.accepted, monitors),
            rejected: bits(&answer.rejected, monitors),
            confirmed: bits(&answer.confirmed, monitors),
            restarted: bits(&answer.restarted, monitors),
            tune_innovation: answer.tune_innovation,
            setting: answer.setting,
            log_evidence: answer.log_evidence,
            linearised: answer.linearised,
            remarks: answer.remarks,
            health: answer.health.iter().map(health).collect::<Option<_>>()?,
        })
    }
}
