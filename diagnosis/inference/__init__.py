"""Statistics of probes, whatever they mean: nuisances, discrepancy, evidence of one effect, two or an unknown one."""
