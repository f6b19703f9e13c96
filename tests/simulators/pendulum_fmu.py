"""A functional mock-up unit built from C: a damped pendulum, q'' = torque - k sin(q) - d q'.

The functions of FMI that FMPy asks for and the pendulum has no use for are stubs that fail.
"""

import subprocess
import sys
import zipfile

SOURCE = r"""
#include <math.h>
#include <stdlib.h>
#include <stddef.h>

typedef struct { double value[8]; void *environment; void (*log)(); } Unit;
enum { Q, V, TORQUE, K, D, TIP, DQ, DV };
static const double START[8] = {0.1, 0.0, 0.0, 9.81, 0.1, 0.0, 0.0, 0.0};

static void begin(Unit *u) { for (int i = 0; i < 8; i++) u->value[i] = START[i]; HIDDEN_RESET }
static void slopes(Unit *u, double t, double q, double v, double *dq, double *dv) {
  *dq = v;
  *dv = u->value[TORQUE] - u->value[K] * sin(q) - u->value[D] * v EXTRA;
}
static int move(Unit *u, double t, double h) {
  int steps = (int)ceil(h / 1e-3 - 1e-9);
  double s = h / steps;
  for (int i = 0; i < steps; i++, t += s) {
    double q = u->value[Q], v = u->value[V], a[4], b[4];
    slopes(u, t, q, v, a, b);
    slopes(u, t + s / 2, q + s / 2 * a[0], v + s / 2 * b[0], a + 1, b + 1);
    slopes(u, t + s / 2, q + s / 2 * a[1], v + s / 2 * b[1], a + 2, b + 2);
    slopes(u, t + s, q + s * a[2], v + s * b[2], a + 3, b + 3);
    u->value[Q] += s / 6 * (a[0] + 2 * a[1] + 2 * a[2] + a[3]);
    u->value[V] += s / 6 * (b[0] + 2 * b[1] + 2 * b[2] + b[3]);
    if (fabs(u->value[Q]) > 1e3) return 3;
  }
  return 0;
}
static void derived(Unit *u) {
  u->value[TIP] = sin(u->value[Q]);
  slopes(u, 0.0, u->value[Q], u->value[V], &u->value[DQ], &u->value[DV]);
}
"""

SECOND = r"""
typedef struct { void (*logger)(); void *allocate, *release, *finished; void *environment; } Calls;
void *fmi2Instantiate(const char *n, int kind, const char *guid, const char *place, const Calls *c,
                      int visible, int logging) {
  Unit *u = calloc(1, sizeof(Unit));
  u->log = c->logger; u->environment = c->environment;
  begin(u);
  return u;
}
void fmi2FreeInstance(void *u) { free(u); }
int fmi2SetupExperiment(void *u, int a, double b, double c, int d, double e) { return 0; }
int fmi2EnterInitializationMode(void *u) { return 0; }
int fmi2ExitInitializationMode(void *u) { return 0; }
int fmi2Terminate(void *u) { return 0; }
int fmi2Reset(void *u) { begin(u); return 0; }
int fmi2GetReal(void *c, const unsigned *r, size_t n, double *x) {
  Unit *u = c; derived(u);
  for (size_t i = 0; i < n; i++) x[i] = u->value[r[i]];
  return 0;
}
int fmi2SetReal(void *c, const unsigned *r, size_t n, const double *x) {
  for (size_t i = 0; i < n; i++) ((Unit *)c)->value[r[i]] = x[i];
  return 0;
}
int fmi2DoStep(void *c, double t, double h, int keep) {
  Unit *u = c;
  int status = move(u, t, h);
  if (status) u->log(u->environment, "pendulum", status, "error", "the rope has torn");
  return status;
}
"""

THIRD = r"""
#include <stdbool.h>
typedef void (*Log)(void *, int, const char *, const char *);
void *fmi3InstantiateCoSimulation(const char *n, const char *token, const char *place, bool visible,
    bool logging, bool events, bool early, const unsigned *r, size_t nr, void *environment,
    Log log, void *update) {
  Unit *u = calloc(1, sizeof(Unit));
  u->log = (void (*)())log; u->environment = environment;
  begin(u);
  return u;
}
void fmi3FreeInstance(void *u) { free(u); }
int fmi3EnterInitializationMode(void *u, bool a, double b, double c, bool d, double e) { return 0; }
int fmi3ExitInitializationMode(void *u) { return 0; }
int fmi3Terminate(void *u) { return 0; }
int fmi3Reset(void *u) { begin(u); return 0; }
int fmi3GetFloat64(void *c, const unsigned *r, size_t n, double *x, size_t m) {
  Unit *u = c; derived(u);
  for (size_t i = 0; i < n; i++) x[i] = u->value[r[i]];
  return 0;
}
int fmi3SetFloat64(void *c, const unsigned *r, size_t n, const double *x, size_t m) {
  for (size_t i = 0; i < n; i++) ((Unit *)c)->value[r[i]] = x[i];
  return 0;
}
int fmi3DoStep(void *c, double t, double h, bool keep, bool *event, bool *end, bool *early,
               double *last) {
  Unit *u = c;
  int status = move(u, t, h);
  *event = *end = *early = false;
  *last = t + h;
  if (status) u->log(u->environment, status, "error", "the rope has torn");
  return status;
}
"""

VARIABLES = (  # name, causality, variability, initial, start, index of the state it derives
    ("q", "local", "continuous", "exact", "0.1", 0),
    ("v", "local", "continuous", "exact", "0", 0),
    ("torque", "input", "continuous", "", "0", 0),
    ("k", "parameter", "fixed", "exact", "9.81", 0),
    ("d", "parameter", "tunable", "exact", "0.1", 0),
    ("tip", "output", "continuous", "calculated", "", 0),
    ("der(q)", "local", "continuous", "calculated", "", 1),
    ("der(v)", "local", "continuous", "calculated", "", 2),
)


def described_second(variables):
    def of(k, name, causality, variability, initial, start, state):
        own = f' initial="{initial}"' if initial else ""
        inner = (f' start="{start}"' if start else "") + (f' derivative="{state}"' if state else "")
        return (
            f'<ScalarVariable name="{name}" valueReference="{k}" causality="{causality}" '
            f'variability="{variability}"{own}><Real{inner}/></ScalarVariable>'
        )

    listed = "".join(of(k, *v) for k, v in enumerate(variables))
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="pendulum" guid="{{pendulum}}">
<CoSimulation modelIdentifier="pendulum" canHandleVariableCommunicationStepSize="true"/>
<ModelVariables>{listed}</ModelVariables>
<ModelStructure><Outputs><Unknown index="6"/></Outputs>
<Derivatives><Unknown index="7"/><Unknown index="8"/></Derivatives>
<InitialUnknowns><Unknown index="6"/><Unknown index="7"/><Unknown index="8"/></InitialUnknowns>
</ModelStructure></fmiModelDescription>"""


def described_third(variables):
    def of(k, name, causality, variability, initial, start, state):
        own = f' initial="{initial}"' if initial else ""
        own += f' start="{start}"' if start else ""
        own += f' derivative="{state}"' if state else ""
        return (
            f'<Float64 name="{name}" valueReference="{k + 1}" causality="{causality}" '
            f'variability="{variability}"{own}/>'
        )

    listed = "".join(of(k, *v) for k, v in enumerate(variables))
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="pendulum" instantiationToken="{{pendulum}}">
<CoSimulation modelIdentifier="pendulum" canHandleVariableCommunicationStepSize="true"/>
<ModelVariables><Float64 name="time" valueReference="100" causality="independent"
variability="continuous"/>{listed}</ModelVariables>
<ModelStructure><Output valueReference="6"/><ContinuousStateDerivative valueReference="7"/>
<ContinuousStateDerivative valueReference="8"/><InitialUnknown valueReference="6"/>
<InitialUnknown valueReference="7"/><InitialUnknown valueReference="8"/></ModelStructure>
</fmiModelDescription>"""


def build(folder, version=2, extra="", hidden_reset="", before="", variables=VARIABLES):
    """Path of a unit, for this platform.

    extra : C added to the acceleration. before : C in front of the functions. hidden_reset : C run
    where the unit begins.
    """
    from fmpy.fmi2 import FMU2Slave
    from fmpy.fmi3 import FMU3Slave

    kind, own = ((FMU2Slave, SECOND), (FMU3Slave, THIRD))[version - 2]
    source = before + SOURCE.replace("EXTRA", extra).replace("HIDDEN_RESET", hidden_reset) + own
    if version == 3:  # value references are counted from 1 there
        source = source.replace("value[r[i]]", "value[r[i] - 1]")
    names = [n for n in dir(kind) if n.startswith(f"fmi{version}")]
    source += "".join(f"int {n}() {{ return 3; }}\n" for n in names if f"{n}(" not in own)
    code, library = folder / "pendulum.c", folder / "pendulum.so"
    code.write_text(source)
    subprocess.run(["cc", "-O2", "-shared", "-fPIC", "-o", library, code, "-lm"], check=True)
    place = {2: "linux64", 3: "x86_64-linux"}[version]
    if sys.platform == "darwin":
        place = {2: "darwin64", 3: "x86_64-darwin"}[version]
    described = (described_second, described_third)[version - 2](variables)
    path = folder / "pendulum.fmu"
    suffix = ".dylib" if sys.platform == "darwin" else ".so"
    with zipfile.ZipFile(path, "w") as unit:
        unit.writestr("modelDescription.xml", described)
        unit.write(library, f"binaries/{place}/pendulum{suffix}")
    return path
