"""Statistics of probes, whatever they mean: nuisances, discrepancy, evidence of one effect, two or an unknown one.

Files:
    inference         all hypotheses with their probabilities
    observed          residual and covariance, alone or together with an effect
    curve_fits        evidence and strength of one effect
    in_series         in which series an effect acts
    pairs             two effects at once
    steady            what a law that does the same to every frame may leave beside itself
    unknown           what no catalogue entry explains
    discrepancy       how far laws of a kind depart from ours (`discrepancy.toml`)
    nuisances         factor models of the nuisances, integrated out: of single series first, then of all
    refine            inner parameters fitted: which effects, in which order, and the loop
    search            one fit: slopes and steps
    inner_parameters  strengths with reach and shape of laws left open
    seen              which residual and series a fit asks
"""
