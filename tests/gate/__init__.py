"""The gate for changes of the verdict: recordings with known answers, diagnosed, judged and compared in pairs."""
