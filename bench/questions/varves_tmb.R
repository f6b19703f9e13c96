# Maximum likelihood of the ice varves by TMB, with standard errors; prints seconds, phi, tau, their
# standard errors and the log-likelihood.
#     Rscript varves_tmb.R varves_tmb.cpp FOLDER ice_varves.csv
# FOLDER is where the compiled model is kept.
suppressMessages(library(TMB))
given <- commandArgs(trailingOnly = TRUE)
source_file <- file.path(given[2], "varves_tmb.cpp")
library_file <- dynlib(sub("\\.cpp$", "", source_file))
if (!file.exists(library_file)) {
  file.copy(given[1], source_file, overwrite = TRUE)
  sink(stderr())
  compile(source_file)
  sink()
}
dyn.load(library_file)
series <- read.csv(given[3])
y <- series[[ncol(series)]]
fit <- function() {
  made <- MakeADFun(
    list(y = y), list(slope = 1, log_tau = 3, x = rep(0, length(y))),
    random = "x", DLL = "varves_tmb", silent = TRUE
  )
  found <- nlminb(made$par, made$fn, made$gr)
  list(table = summary(sdreport(made), "report"), value = -found$objective)
}
invisible(fit()) # whatever R loads on first use
took <- system.time(answer <- fit())[["elapsed"]]
cat(took, answer$table["phi", ], answer$table["tau", ], answer$value, "\n")
