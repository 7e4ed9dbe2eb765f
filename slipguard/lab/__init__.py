"""The offline commands: measure, bench, train, dataset, campaign."""
