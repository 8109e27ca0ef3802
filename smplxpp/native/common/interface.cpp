// Which interface this build has: raised with every change of an exported function, so that a library from older sources is
// not called with arguments that it does not know.
#include "common/status.hpp"

SMPLXPP_EXPORT int32_t smplxpp_interface() { return 10; }
