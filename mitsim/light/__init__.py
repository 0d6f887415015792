"""The projector's and the lamps' light, sampled: settings, passes, rounds of sampling, plan, light file."""
