// --- part: decide_pairs

const double scale = Bits::unit_scale(radius);
int room[ROOM];
for (;;) {
    const long long begin = (long long)__atomic_fetch_add(&info.data[0], 1, __ATOMIC_RELAXED) * CHUNK;
    if (begin >= n)
        break;
    for (long long q = begin; q < n && q < begin + CHUNK; ++q) {
        const real* p = positions.data + (long long)DIM * particle.data[q];
        const real* shape = corners.data + (long long)DIM * DIM * triangle.data[q];
        near.data[q] = asked.data[q] && Shape::near(p, shape, radius, scale, room);
    }
}
