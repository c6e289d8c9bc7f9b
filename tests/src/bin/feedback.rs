//! Prototype.
use system_tests::feedback::*;
fn main() {
    let arg = |i: usize, d: f64| std::env::args().nth(i).map_or(d, |a| a.parse().unwrap());
    let known = Known::read(arg(2, 1e-5) as f32).unwrap();
    let seed = arg(1, 1.0) as u64;
    let (walk, ground) = (arg(3, 1e-5), arg(4, 2e-7));
    let gain = arg(5, 0.4) as f32;
    let mut s = Scenario { walk, ground, ..Scenario::quiet(seed, 2400) };
    s.events = vec![
        (300, Event::Moves(10, [4e-4, 4e-4])),
        (600, Event::Steps(7, 1.03)),
        (900, Event::Sticks(5, 250)),
        (1000, Event::Moves(20, [2e-4, 2e-4])),
        (1200, Event::Lost(10)),
        (1400, Event::Silent(vec![3, 20], 200)),
        (1700, Event::Momentum(5e-4, 100)),
        (2000, Event::Gap(100)),
        (2200, Event::Steps(30, 0.97)),
    ];
    for control in [Control::Off, Control::Design, Control::Estimated] {
        let t = std::time::Instant::now();
        let mut f = recommended();
        f.gain = gain;
        let mut l = Loop::new(&known, f, control, s.clone()).unwrap();
        println!("{control:?}");
        let mut samples = vec![];
        for i in 0..s.frames {
            match l.cycle() { Ok(x) => samples.push(x), Err(e) => { println!("{i} {e}"); break } }
        }
        for (i, c) in samples.chunks(50).enumerate() {
            let m = c.len() as f64;
            let rms = (c.iter().map(|s| s.rms * s.rms).sum::<f64>() / m).sqrt();
            let held = c.iter().filter(|s| s.steered.is_some_and(|s| s.hold.is_some())).count();
            let mut why: Vec<_> = c.iter().filter_map(|s| s.steered.and_then(|s| s.hold)).map(|h| format!("{h:?}")).collect();
            why.dedup();
            let l = c[c.len() - 1];
            println!("{:5} rms {:.3} mm end {:.3} held {:2} aside {:2} nis {:6.1} nees {:6.2} sigma {:.2}% max {:.1} A {:?} {}", i * 50, 1e3 * rms, 1e3*l.rms, held,
                c.iter().filter(|s| s.aside).count(), c.iter().map(|s| f64::from(s.nis)).sum::<f64>() / m, l.nees, 100.0 * l.sigma, l.largest, l.steered.map(|s| (s.left_out, s.limited)), why.join(" "));
        }
        println!("{:?}", t.elapsed());
    }
}
