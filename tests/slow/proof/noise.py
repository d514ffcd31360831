"""The null test at length: labels that are independent of the trace, four in five good, through the whole loop.

    python -m tests.slow.proof.noise --data insertion --reducer conv --seeds 100:110

Prints how many of the cycles came out certain in each replay; an honest engine is certain of next to nothing.
"""

from __future__ import annotations

import argparse

import numpy as np

from dengine import Recipe, load_dataset, replay


def main() -> None:
    """Parse, replay, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default="insertion", help="a bundled set, or an .npz file with X and y")
    parser.add_argument("--samples", type=int, help="use the first so many samples of each trace; all by default")
    parser.add_argument("--reducer", default="conv", help="a recipe's name or TOML file, or module:Class")
    parser.add_argument("--seeds", default="100:110", help="first:last, the last one left out; a replay each")
    parser.add_argument("--cycles", type=int, default=1503, help="cycles of a replay, at most as many as there are traces")
    args = parser.parse_args()
    data = load_dataset(args.data, args.samples)
    recipe = Recipe.load(args.reducer).with_policy(alpha=0.1, lower_bound=0.9)
    certain, cycles = [], min(args.cycles, len(data))
    for seed in range(*map(int, args.seeds.split(":"))):
        noise = np.random.default_rng(seed).permutation(np.arange(len(data)) < 0.8 * len(data)).astype(int)
        certain.append(replay((data.X, noise), recipe, seed, cycles=cycles).summary()["certain"])
    print(f"{args.reducer} on {data.name}, noise labels: certain {certain}, mean {np.mean(certain):g} of {cycles} cycles")


if __name__ == "__main__":
    main()
