"""The report of a run, its figures, and plots of results in memory. Nothing is computed here that is not displayed.

    metrics.json, run folder ──► render ──► report.html
    run folder ──► write_figures ──► PNG and PDF
    a result in memory ──► its method plot ──► matplotlib Figure

Only this package imports matplotlib and Jinja2, when something is drawn; pyplot is never touched.

Examples
--------
>>> import kros
>>> motors = kros.plants.DcMotorPopulation(n_units=1, n_episodes=1, seconds=1.0).simulate().population
>>> motors.plot().axes[0].get_xscale()
'linear'
"""
