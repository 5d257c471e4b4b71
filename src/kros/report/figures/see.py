"""What to see in every figure: the first sentence of its caption."""

SEE = {
    "signals": "Signals should look alike from episode to episode; what differs between conditions is what an observer has to follow.",
    "tracking_spectrum": "Peaks at the dotted lines are the gearbox's doing, and what the lifting is there to model.",
    "phase": "Phases may lie anywhere around the circle; lags should be nearly the same for all units, and concentrations near one.",
    "models": "The spread of the lines is what the uncertainty model has to cover.",
    "free_run": "The nearer a line stays to the recorded one, the better the model predicts with nothing measured.",
    "free_run_spectra": "The lower line is the better model, above all in the shaded band.",
    "forms": "The lowest line is the form in which units differ least; the thick one is in use.",
    "weights": "Lines should lie close to their shade: what is between them is uncertainty that no unit shows.",
    "forms_entrywise": "Every thin line lies below the thick one: entries alone make a form look smaller than it is.",
    "weights_entrywise": "Black lines lie above all blue ones: entries are bounded, which is less than bounding the perturbation.",
    "synthesis": "Where the weights are low the correction may be small; where they are high it has to follow the measurements.",
    "observers_in_time": "The flatter an error, the better the estimate; the zoom shows how much of the oscillation is left in it.",
    "observers_in_time_paper": "The flatter an error, the better the estimate; compare with the deployed pair.",
    "observer_spectra": "The lower line is the better observer.",
    "loaded_paper": "Slow waves of the current's error are the load's torque; what is fast is error.",
    "loaded_spectra": "The lower line is the better observer away from the load's own slow motion.",
    "load_torque": "The nearer a line stays to the declared load, the better the estimate of the torque.",
    "robustness": "Where a line bends upwards, the disturbance is more than the observer can take.",
    "outlier_scores": "A point above the dashed line is a unit that does not belong to the batch.",
    "outlier_residuals": "Where the red line leaves the black one, the unit differs in that response.",
}
