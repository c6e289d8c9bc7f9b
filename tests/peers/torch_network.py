"""The network in PyTorch: same weights, same batch, outputs and derivatives of `network_peer`; and samples learnt a second.

    cargo run --release -p training --example network_peer -- target/peer
    python tests/peers/torch_network.py target/peer

PyTorch is 540 MB to download and 5.4 GB installed: it stays in an environment of its own, and nothing else needs it.
"""

import sys
import time

import numpy as np
import torch

BATCH, INPUTS, HIDDEN, OUTPUTS = 256, 77, 400, 15
SHAPES = [(HIDDEN, INPUTS), (HIDDEN, HIDDEN), (HIDDEN, HIDDEN), (OUTPUTS, HIDDEN)]


def read(folder, name):
    return np.fromfile(f"{folder}/{name}", "<f4")


def unpack(numbers):
    """Weights, stored by columns, and biases."""
    for outputs, inputs in SHAPES:
        weight, numbers = numbers[: outputs * inputs], numbers[outputs * inputs :]
        bias, numbers = numbers[:outputs], numbers[outputs:]
        yield weight.reshape(inputs, outputs).T.copy()
        yield bias


def smooth(z):
    t = z.clamp(-1, 1) + 1
    return t * t / 4 + (z - 1).clamp(min=0)


def forward(p, x):
    h = smooth(x @ p[0].T + p[1])
    h = h + smooth(h @ p[2].T + p[3])
    h = h + smooth(h @ p[4].T + p[5])
    return h @ p[6].T + p[7]


def off(ours, theirs):
    """Largest difference over the largest number."""
    return float(np.abs(ours - theirs).max() / np.abs(theirs).max())


def main(folder):
    worst = 0.0
    for dtype in (torch.float32, torch.float64):
        p = [torch.tensor(v, dtype=dtype, requires_grad=True) for v in unpack(read(folder, "network"))]
        x = torch.tensor(read(folder, "inputs").reshape(BATCH, INPUTS), dtype=dtype, requires_grad=True)
        target = torch.tensor(read(folder, "targets").reshape(BATCH, OUTPUTS), dtype=dtype)
        y = forward(p, x)
        loss = ((y - target) ** 2).sum() / BATCH
        slopes = torch.autograd.grad(loss, p, retain_graph=True)
        by_input = torch.autograd.grad(y.sum(), x)[0]
        pairs = [(read(folder, "outputs").reshape(BATCH, OUTPUTS), y.detach().numpy())]
        pairs += [(ours, theirs.numpy()) for ours, theirs in zip(unpack(read(folder, "slopes")), slopes)]
        pairs += [(read(folder, "by_input").reshape(BATCH, INPUTS), by_input.numpy())]
        each = [off(ours, theirs) for ours, theirs in pairs]
        print(f"{dtype}: outputs {each[0]:.1e}, derivatives by weights and biases {max(each[1:-1]):.1e}, by inputs {each[-1]:.1e}")
        worst = max(worst, *each)
    assert worst < 1e-5, worst
    torch.set_num_threads(2)
    p = [torch.tensor(v, requires_grad=True) for v in unpack(read(folder, "network"))]
    adam = torch.optim.Adam(p, lr=1e-3)
    batch, steps = 2048, 40
    x, target = torch.randn(batch, INPUTS), torch.randn(batch, OUTPUTS)
    for step in range(steps + 5):
        start = time.time() if step == 5 else start if step > 5 else 0
        loss = ((forward(p, x) - target) ** 2).sum() / batch
        adam.zero_grad()
        loss.backward()
        adam.step()
    print(f"PyTorch {torch.__version__}, Adam, two threads: {batch * steps / (time.time() - start):.0f} samples a second")


if __name__ == "__main__":
    main(sys.argv[1])
