// Structures that Python fills: each list of fields declares the structure and describes it to Python.
//
// Python owns all memory. A structure holds numbers, and pointers to arrays, to other structures and to functions;
// `NAME_fields()` returns its layout as one line per field, from which `ur_core.kernel` builds the same structure and
// checks every array's type and size.
#pragma once

#include <stdint.h>

#define DECLARE_INT(name) int64_t name;
#define DECLARE_REAL(name) double name;
#define DECLARE_INTS(name, size) int64_t* name;
#define DECLARE_REALS(name, size) double* name;
#define DECLARE_LINK(name, type) const type* name;
#define DECLARE_FUNCTION(name, type) type name;

#define DESCRIBE_INT(name) "int " #name "\n"
#define DESCRIBE_REAL(name) "real " #name "\n"
#define DESCRIBE_INTS(name, size) "ints " #name " " #size "\n"
#define DESCRIBE_REALS(name, size) "reals " #name " " #size "\n"
#define DESCRIBE_LINK(name, type) "link " #name " " #type "\n"
#define DESCRIBE_FUNCTION(name, type) "function " #name "\n"

#define STRUCTURE(Name, FIELDS)                                                                                        \
    struct Name {                                                                                                      \
        FIELDS(DECLARE_INT, DECLARE_REAL, DECLARE_INTS, DECLARE_REALS, DECLARE_LINK, DECLARE_FUNCTION)                 \
    };                                                                                                                 \
    EXPORT const char* Name##_fields() {                                                                               \
        return FIELDS(DESCRIBE_INT, DESCRIBE_REAL, DESCRIBE_INTS, DESCRIBE_REALS, DESCRIBE_LINK, DESCRIBE_FUNCTION);   \
    }

// Sizes of a function's arguments, in their order: a number of values for an array, "-" for all else. Factors are numbers,
// the positions of other arguments as $0, $1, and fields of a structure there as $0.pairs. `ur_core.kernel.call` checks
// them.
#define SIZES(function, sizes)                                                                                         \
    EXPORT const char* function##_sizes() { return sizes; }

#define EXPORT extern "C" __attribute__((visibility("default")))
