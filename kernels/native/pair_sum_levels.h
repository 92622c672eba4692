// --- part: begin

struct Points { number p[3]; };
alignas(128) real near_points[3][CANDIDATES];
alignas(128) real near_column[OTHERS + STEPS + 1][CANDIDATES];
memset(near_points, 0, sizeof near_points);
memset(near_column, 0, sizeof near_column);
int candidate_ids[SUMS == 2 ? CANDIDATES : 1], candidate_images[SUMS == 2 ? CANDIDATES : 1];
memset(candidate_ids, 0, sizeof candidate_ids);
memset(candidate_images, 0, sizeof candidate_images);
constexpr bool several = true;
const int image = home;
// --- part: begin_query

    int hits = 0;
    bool fresh = true;
    auto add = [&](bool finished) __attribute__((noinline)) {
        $flush
        $begin
        for (int b = 0; b < hits; b += LANES) {
            const Math::flag real_lanes = lanes_of(hits - b < LANES ? (1u << (hits - b)) - 1 : (1u << LANES) - 1);
            Points points;
            for (int k = 0; k < DIM; ++k)
                points.p[k] = *(const number*)(near_points[k] + b);
            $each
        }
        $after
        $keep
        fresh = false;
        hits = 0;
    };
// --- part: pair

                for (int k = 0; !PERIODIC && k < DIM; ++k)
                    near_points[k][hits] = axes.data[k * stride + c];
                for (int s = 0; s < OTHERS; ++s)
                    memcpy(&near_column[s][hits], columns.data + (long long)s * n + c, sizeof(real));
// --- part: step

                near_column[OTHERS + $c][hits] = real(shift[$axis] - Lattice::turn(columns.data[(long long)OTHERS * n + c], $axis));
// --- part: end_pair

                if constexpr (SUMS == 2) {
                    candidate_ids[hits] = other;
                    candidate_images[hits] = image;
                }
                if (++hits == CANDIDATES)
                    add(false);
