"""The null test at length: labels that are independent of the trace, four in five good, through the whole loop.

    python training/check_noise.py --data insertion --reducer conv --seeds 100:110

Prints how many of 1503 cycles came out certain in each replay; an honest engine is certain of next to nothing.
"""

from __future__ import annotations

import argparse

import numpy as np

from dengine import Recipe, load_dataset, replay


def main() -> None:
    """Parse, replay, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default="insertion")
    parser.add_argument("--samples", type=int)
    parser.add_argument("--reducer", default="conv")
    parser.add_argument("--seeds", default="100:110", help="first:last")
    args = parser.parse_args()
    data = load_dataset(args.data, args.samples)
    recipe = Recipe.load(args.reducer).with_policy(alpha=0.1, lower_bound=0.9)
    certain = []
    for seed in range(*map(int, args.seeds.split(":"))):
        noise = np.random.default_rng(seed).permutation(np.arange(len(data)) < 0.8 * len(data)).astype(int)
        certain.append(replay((data.X, noise), recipe, seed, cycles=1503).summary()["certain"])
    print(f"{args.reducer} on {data.name}, noise labels: certain {certain}, mean {np.mean(certain):g} of 1503 cycles")


if __name__ == "__main__":
    main()
