// The ice varves for TMB: the joint negative log density, of which TMB takes Laplace's approximation
// over x. See bench/questions/varves_tmb.R.
#include <TMB.hpp>

template <class Type> Type objective_function<Type>::operator()() {
  DATA_VECTOR(y);
  PARAMETER(slope);    // atanh(phi)
  PARAMETER(log_tau);
  PARAMETER_VECTOR(x);
  Type phi = tanh(slope), tau = exp(log_tau), sd = 1 / sqrt(tau);
  Type minus = -dnorm(x(0), Type(0), sd / sqrt(1 - phi * phi), true);
  for (int t = 1; t < x.size(); t++) minus -= dnorm(x(t), phi * x(t - 1), sd, true);
  for (int t = 0; t < y.size(); t++)
    minus -= dgamma(y(t), Type(6.25), exp(x(t)) / Type(0.256), true);
  ADREPORT(phi);
  ADREPORT(tau);
  return minus;
}
