// Image codes of the slots of a list, CODE_BYTES each; 0 where a pair has one image.
#pragma once
#include "constants.h"
#include "device.h"

JFRNN_FUNCTION int image_code(const int* codes, long long slot) {
    if constexpr (CODE_BYTES == 1)
        return ((const unsigned char*)codes)[slot];
    else if constexpr (CODE_BYTES == 2)
        return ((const short*)codes)[slot];
    else
        return CODE_BYTES == 4 ? codes[slot] : 0;
}
