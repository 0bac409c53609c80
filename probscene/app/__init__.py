"""The application: command line, runs and reports; the only library code that joins the packages."""
