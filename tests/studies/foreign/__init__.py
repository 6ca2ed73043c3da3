"""Recordings by simulators that share no code with omnibench or with ``hidden``: one kind of trouble a file.

Every file has its own robot, commands, integrator and noise, and ``make(folder, seed)``, which writes a data set and
returns what a judge needs: kind, covariates (where a locator should see it), size and non-centrality, and right_names
where the catalogue has effects of that cause.
"""
