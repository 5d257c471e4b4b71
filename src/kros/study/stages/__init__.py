"""One file a stage; each reads artifacts, writes artifacts and returns the files it wrote."""
