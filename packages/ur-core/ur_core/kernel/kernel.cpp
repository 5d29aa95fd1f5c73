// The compiled control kernel, as one unit.
#include "adapter.hpp"
#include "clearance.hpp"
#include "counters.hpp"
#include "forward.hpp"
#include "gate.hpp"
#include "geometry.hpp"
#include "grippers.hpp"
#include "inverse.hpp"
#include "lead.hpp"
#include "motion.hpp"
#include "threads.hpp"
#include "wrench.hpp"

SIZES(envelope_cartesian_use, "- 12*$0.width*$4 2*$4 2*$4 -")
SIZES(envelope_limit, "- 12*$0.width*$2 -")

// Hash of the sources that this library was compiled from.
EXPORT const char* kernel_sources() { return KERNEL_SOURCES; }
