# The vars by BoosterUQ from the differences that boosteruq_pairs.py wrote, beside orbitcal.csv in the same folder.
#
#     julia --project=ENVIRONMENT tests/peers/boosteruq.jl PATH/TO/BoosterUQ target/boosteruq/pairs.csv
#
# Not run yet; written after BoosterUQ's API guide.

using DelimitedFiles, Statistics, Turing

const SOURCE, PAIRS = ARGS
include(joinpath(SOURCE, "src", "booster_batched_uq.jl"))
using .BoosterBatchedUQ

rows, header = readdlm(PAIRS, ',', Float64; header=true)
points = [
    (idipo=row[1], iqhc=row[2], iqvc=row[3], ish=row[4], isv=row[5], corrector_currents=Tuple(row[6:53])) for
    row in eachrow(rows)
]
observed = rows[:, 54:86]
# the two faulty monitors are left out as there
faulty = vec(map(in(("x_C6_mm", "y_B5_mm")), header))[54:86]
noise = [faulty[b] ? 1e6 : sqrt(2) * 0.15 for _ in axes(observed, 1), b in axes(observed, 2)]

problem = BoosterBatchProblem(
    prepare_booster_batch(points, observed; noise_std_mm=noise); sensitivity=BatchedForwardSensitivity(chunksize=8)
)
value_and_gradient!(problem, ones(48)) # compiled
println("value and gradient: ", median(@elapsed(value_and_gradient!(problem, ones(48))) for _ in 1:9), " s")

chain = sample(booster_model(problem, lognormal_quad_prior(0.03)), NUTS(500, 0.65), 2000)
draws = Array(group(chain, :quad_factors))
ours, _ = readdlm(joinpath(dirname(PAIRS), "orbitcal.csv"), ','; header=true)
for (var, name) in enumerate(ours[:, 1])
    println(name, ": ", mean(draws[:, var]), " ± ", std(draws[:, var]), ", orbitcal ", ours[var, 2], " ± ", ours[var, 3])
end
