# Values of robustbase for the tests: Rscript tests/linear/robustbase.R > tests/linear/robustbase.json
suppressMessages({library(robustbase); library(MASS)})
fits <- function(d) {
  y <- d[[1]]; x <- cbind(1, as.matrix(d[-1]))
  out <- NULL
  for (seed in 1:5) {
    set.seed(seed)
    f <- try(suppressWarnings(lmrob.fit(x, y, lmrob.control(nResample=2000, k.max=5000, max.it=5000, refine.tol=1e-14, rel.tol=1e-14))), silent=TRUE)
    if (inherits(f, "try-error") || !isTRUE(f$converged) || f$scale < 1e-8*mad(y)) next
    if (is.null(out) || f$scale < out$scale*(1-1e-10)) out <- f
  }
  if (is.null(out)) return(NULL)
  class(out) <- "lmrob"
  v <- try(robustbase:::.vcov.avar1(out, x), silent=TRUE)
  if (inherits(v, "try-error")) return(NULL)
  w <- out$rweights; r <- out$residuals
  a <- 1.207617
  ybar <- sum(w*y)/sum(w); S <- sum(w*(y-ybar)^2); R <- sum(w*r^2)
  n <- nrow(x); p <- ncol(x)
  # the stored residuals are not those of the best start: no standard errors
  if (max(abs(out$init$resid - (y - x %*% out$init.S$coefficients))) > 1e-6 * out$scale) v[] <- NA
  list(coef=unname(out$coefficients), scale=out$scale, se=unname(sqrt(diag(v))), s_coef=unname(out$init.S$coefficients), r2=(S-R)/(S+R*(a-1)))
}
num <- function(v) if (anyNA(v)) "null" else paste0("[", paste(sprintf("%.10g", v), collapse=", "), "]")
first <- TRUE; cat("[\n")
for (pkg in c("robustbase","MASS","datasets")) {
  items <- data(package=pkg)$results[,"Item"]
  for (it in items) { nm <- sub(" .*","",it); e <- new.env()
    src <- if (grepl("\\(", it)) sub(".*\\((.*)\\)","\\1",it) else nm
    ok <- try({data(list=src, package=pkg, envir=e); d <- get(nm, envir=e)}, silent=TRUE)
    if (inherits(ok,"try-error") || !is.data.frame(d)) next
    keep <- sapply(d, function(c) is.numeric(c) && length(unique(c))>4)
    d <- as.data.frame(na.omit(d[,keep,drop=FALSE])); n <- nrow(d)
    if (ncol(d) < 2) next
    d <- d[,c(ncol(d), 1:min(ncol(d)-1,6))]   # the last column on at most six others
    p <- ncol(d)
    if (n < 5*p || n > 600) next
    if (qr(cbind(1,as.matrix(d[-1])))$rank < p) next
    f <- fits(d); if (is.null(f)) { message("left out ", nm); next }
    if (!first) cat(",\n"); first <- FALSE
    cat(sprintf('{"package": "%s", "name": "%s", "columns": ["%s"], "rows": %d, "coef": %s, "scale": %.10g, "error": %s, "s_coef": %s, "r_squared": %.10g}', pkg, nm, paste(names(d), collapse='", "'), n, num(f$coef), f$scale, num(f$se), num(f$s_coef), f$r2))
  } }
cat("\n]\n")
