"""The proof of the rules without a network: a second implementation plays thousands of replays."""
