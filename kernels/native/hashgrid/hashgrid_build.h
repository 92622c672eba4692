// Builds `wp.HashGrid` by the function of Warp's library that `wp.HashGrid.build` calls: on the host, for the CPU and for CUDA.
//
// On CUDA that function works in a static variable, so calls take turns whatever grid they build. It launches on the stream that Warp
// has for the context, which is set to that of the call meanwhile.
#pragma once
#include "constants.h"
#include "float_control.h"
#include "warp_types.h"
#include "warp_hashgrid.h"

struct HashGridBuildArguments {
    const real* scratch;                 // the points
    const int* stream;                   // of CUDA, on which the call works
    const int* grid;                     // what Warp calls its id
    int* points;                         // how Warp describes an array of as many; the address of the points comes first
    const int *update, *context;         // the function; the context of CUDA, or none
    const int *get_stream, *set_stream;  // functions of Warp: on which stream of a context it works
    int width_low, width_high;           // the bits of the width of cells
};

struct HashGridBuild : HashGridBuildArguments {
    explicit HashGridBuild(const HashGridBuildArguments& given) : HashGridBuildArguments(given) {}

    void build() const {
        using GetStream = const void* (*)(const void* context);
        using SetStream = void (*)(const void* context, const void* stream, int wait);
        const FloatControl floats{};  // denormals are kept
        *(const void**)points = scratch;
        if (context == nullptr) {
            update_grid();
            return;
        }
        const void* before = ((GetStream)get_stream)(context);
        ((SetStream)set_stream)(context, stream, 0);
        update_grid();
        if (((GetStream)get_stream)(context) == stream)  // unless another thread has set its own meanwhile
            ((SetStream)set_stream)(context, before, 0);
    }
    void update_grid() const {
        using Update = void (*)(wp::uint64_t id, int type, double cell_width, const void* points, const void* groups);
        const wp::uint64_t bits = (wp::uint64_t)(unsigned int)width_high << 32 | (unsigned int)width_low;
        double width;
        memcpy(&width, &bits, 8);
        const int type = DOUBLE ? wp::HASH_GRID_TYPE_FLOAT64 : wp::HASH_GRID_TYPE_FLOAT32;
        ((Update)update)((wp::uint64_t)grid, type, width, points, nullptr);
    }
};
